"""The result of a baseline after each answer."""

from typing import NamedTuple

from bayespbrl.policies.policy import Sampler

MOST_QUESTIONS = 10  # for each answer, where an expert skips some


class Step(NamedTuple):
    """The state of a baseline after an answer.

    Attributes:
      answers: number so far, ties included; a question that was skipped has none.
      pairs: those that stated a preference.
      policy: what it would act by now.
    """

    answers: int
    pairs: int
    policy: Sampler
