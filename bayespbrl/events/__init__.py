"""The events of a run and the learner's state: the state is a fold over an append-only log of events.

Resuming a run, undoing an answer and reporting on a run in progress all use this fold. There are five events:

* `collected`: new trajectories (step 3), and which of them to ask about, in order (step 4); `restarted` where they
  follow the first policy again;
* `asked`: a question, with the order in which the two trajectories were shown, the number of the earlier question that
  it `repeats`, if any, the `answerer` who is asked, where several people answer at once, and `duel` where it is about
  the two alone;
* `answered`: the expert's answer; where known `answerer`, the name of who gave it, `seconds`, the time they took,
  `session`, which the answers of a sitting share, and `replays`, how often the clips began again;
* `improved`: a new estimate and a new policy (steps 1 and 2), which end an iteration: the `check` of the policy before
  it, the number of the policy that is `kept`, `confirmed` where an answer made a restarted one that, `nominated` where
  the new policy may be better than that one, the decision on the KL `bound`, the `value` of the new policy, and
  the `summary` for reports, which the learner never reads;
* `undone`: the last answer and everything after it is taken back, by `answerer`, where known.

state                    what the learner knows between two calls
entry                    one event, as a log keeps it
fold                     the state after one more event
"""

from bayespbrl.events.entry import (
    MOST_REPLAYS,
    Entry,
    Log,
    answered,
    clips_in,
    has_figures,
    plain,
    surviving,
    undone,
)
from bayespbrl.events.fold import apply, replay
from bayespbrl.events.state import LearnerState, NumberedPolicy, Restart

__all__ = [
    "MOST_REPLAYS",
    "Entry",
    "LearnerState",
    "Log",
    "NumberedPolicy",
    "Restart",
    "answered",
    "apply",
    "clips_in",
    "has_figures",
    "plain",
    "replay",
    "surviving",
    "undone",
]
