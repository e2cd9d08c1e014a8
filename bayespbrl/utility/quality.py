"""The quality of a utility estimate: its convergence and its fit to the answers."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class FitQuality:
    """Convergence of an estimate, and its fit to the answers.

    Attributes:
      converged: R̂ and effective sample size, or the linear program's status, are in order.
      status: in words.
      pairs, pairs_satisfied: the number of ordered pairs, ties left out, and of those with a positive margin (eq. 6).
      rhat_max, effective_sample_size_min: the worst of what must converge (`sample_posterior`; NaN where there are no
        draws).
      log_evidence: log marginal likelihood of the answers (NaN where it cannot be told, or there is no posterior).
    """

    converged: bool
    status: str
    pairs: int
    pairs_satisfied: int
    rhat_max: float = float("nan")
    effective_sample_size_min: float = float("nan")
    log_evidence: float = float("nan")

    def summary(self) -> dict[str, Any]:
        """The figures as an iteration reports them."""
        return {
            "pairs": self.pairs,
            "pairs_satisfied": self.pairs_satisfied,
            "rhat_max": self.rhat_max,
            "effective_sample_size_min": self.effective_sample_size_min,
            "utility_converged": self.converged,
            "utility_status": self.status,
            "log_evidence": self.log_evidence,
        }
