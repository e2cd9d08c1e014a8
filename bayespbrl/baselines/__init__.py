"""The paper's baselines, as iterators that yield a `Step` after each answer: PF and EPMC."""

from bayespbrl.baselines.epmc import every_visit_preferences
from bayespbrl.baselines.pf import programming_by_feedback
from bayespbrl.baselines.steps import Step

BASELINES = {"pf": programming_by_feedback, "epmc": every_visit_preferences}

__all__ = ["BASELINES", "Step", "every_visit_preferences", "programming_by_feedback"]
