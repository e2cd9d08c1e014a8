"""The paper's baselines, as iterators that yield a `Step` after each answer: PF and EPMC."""

from bayespbrl.baselines.epmc import GridPolicy, every_visit_preferences
from bayespbrl.baselines.pf import programming_by_feedback, transition_table
from bayespbrl.baselines.steps import Step

BASELINES = {"pf": programming_by_feedback, "epmc": every_visit_preferences}
# What each needs of an opened environment; `ValueError` where it is not there.
NEEDED = {"pf": transition_table, "epmc": GridPolicy.initial}

__all__ = ["BASELINES", "NEEDED", "Step", "every_visit_preferences", "programming_by_feedback"]
