"""The result of a baseline after each answer."""

from typing import NamedTuple

from bayespbrl.policies.policy import Sampler


class Step(NamedTuple):
    """The state of a baseline after an answer.

    Attributes:
      answers: number of questions so far, ties and those that were skipped included.
      pairs: those that stated a preference.
      policy: what it would act by now.
    """

    answers: int
    pairs: int
    policy: Sampler
