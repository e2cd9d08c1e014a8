"""Several people answer one run at once: each a question of their own, under their own name."""

import json
import shutil
from contextlib import closing
from dataclasses import replace

import pytest
from test_page import KEYS, answers_of, call, next_turn, served, tab, turn_of
from toys import QUICK, fingerprint

import bayespbrl
from bayespbrl import events
from bayespbrl.cli.commands import main
from bayespbrl.diagnostics import people
from bayespbrl.events import Entry
from bayespbrl.people.foresight import Foresight
from bayespbrl.people.seat import Stale
from bayespbrl.people.session import Session
from bayespbrl.people.views import FAILED, FINISHED, QUESTION, WAITING
from bayespbrl.preferences import Answer, Preferences

WAIT = 120  # seconds at most
SEEN = (QUESTION, WAITING, FINISHED, FAILED)
NAMES = ["Ada", "Ben"]
LONGER = QUICK | {"iterations": 5}


@pytest.fixture
def sitting(tmp_path):
    """Opens a session of two people who are here, over a run on the disk; closes it."""
    opened = []

    def sit(learner=None, **options):
        learner = learner or bayespbrl.start("gridworld", tmp_path / "run", expert="page", **LONGER)
        session = Session(learner, answerer=NAMES, **options).open()
        opened.append(session)
        return session, *((seat, seat.listen(lambda: None)) for seat in session.seats)

    yield sit
    for session in opened:
        session.close()


def settled(session):
    """Wait until everybody is shown something."""
    with session.changed:
        assert session.changed.wait_for(lambda: all(seat.view["phase"] in SEEN for seat in session.seats), WAIT)


def query_of(seat):
    return next(query for query in seat.session.learner.state.open if query.number == seat.number)


def logged(learner, kind):
    events = map(json.loads, learner.log.log_file.read_text().splitlines())
    return [event for event in events if event["event"] == kind]


def test_two_people_answer_a_whole_run_at_once_and_no_question_is_shown_to_both(sitting):
    session, (ada, _), (ben, _) = sitting()
    expert, seen, both = bayespbrl.ReturnExpert(), {"Ada": set(), "Ben": set()}, 0
    slow = 0
    while not session.over:
        settled(session)
        asked = [seat for seat in (ada, ben) if seat.view["phase"] == QUESTION]
        both += len(asked) == 2
        for seat in asked:
            query = query_of(seat)
            seen[seat.answerer].add((query.number, frozenset((query.first, query.second))))
        for seat in asked[:1] if slow % 3 else asked[-1:]:  # now one, now the other is faster
            seat.answer(seat.view["turn"], str(expert(*query_of(seat).trajectories)), 1.0)
        slow += 1
    learner = session.learner
    assert (session.view["phase"], learner.state.iteration) == (FINISHED, 5)
    assert both >= 4
    assert not seen["Ada"] & seen["Ben"]
    assert len({pair for _, pair in seen["Ada"] | seen["Ben"]}) == len(seen["Ada"] | seen["Ben"])
    answered = logged(learner, "answered")
    assert len(answered) == learner.preferences.answers >= 5
    assert {(event["answerer"], event["query"]) for event in answered} <= {
        (name, number) for name, numbers in seen.items() for number, _ in numbers
    }
    assert {event["answerer"] for event in answered} == set(NAMES)
    assert {row.answerer for row in learner.preferences.rows()} - {None} == set(NAMES)
    assert fingerprint(bayespbrl.load(learner.log.path).learner) == fingerprint(learner)


def test_an_answer_follows_as_if_nobody_else_were_there(sitting):
    """The other one's open question holds nobody up, and changes nothing but the number of the next question."""
    session, (ada, _), (ben, _) = sitting()
    settled(session)
    ben_at = ben.number
    for _ in range(2):  # what the first iteration wants
        settled(session)
        ada.answer(ada.view["turn"], "first")
    settled(session)
    assert (session.learner.state.iteration, ben.number) == (1, ben_at)
    ben.answer(ben.view["turn"], "second")  # to a question of the first iteration, in the second
    settled(session)
    assert session.learner.state.iteration == 2
    assert session.learner.preferences.answers == 3


def by_two(budget, ends=lambda state, held: False):
    """A run of two people of whom Ada leaves repeated questions for later, until `ends` of the state and who holds."""
    options = {"expert": "other", "repeats": 0.3, "iterations": 25, "answers": budget, "utility": "linear-program"}
    learner = bayespbrl.Learner("gridworld", **QUICK | options)
    ahead = Foresight(learner.cycle, learner.state, lambda *_: (None, tuple(Answer)), NAMES, several=True)
    while not learner.finished:
        while not ahead.present.complete:
            if isinstance(piece := ahead.compute(ahead.present), Entry):
                assert piece.event["event"] != "asked" or learner.preferences.answers < budget
                learner.record(piece)
            ahead.keep(ahead.present, piece)
        held = dict(ahead.present.holders)
        if learner.finished or ends(learner.state, held):
            break
        again = {query.number for query in learner.state.open if query.repeats is not None}
        number = next((number for number in held if number not in again), next(iter(held)))
        learner.record(events.answered(number, Answer.FIRST, answerer=held[number]))
        ahead.move(number, Answer.FIRST, learner.state)
    return learner


@pytest.mark.parametrize("budget", [7, 10])
def test_nobody_is_asked_beyond_the_budget_where_the_last_answer_is_to_a_repeated_question(budget):
    learner = by_two(budget)
    assert (learner.preferences.answers, learner.finished, learner.state.open) == (budget, True, ())


def test_a_repeated_question_that_somebody_left_takes_no_answer_beyond_the_budget():
    def one_left(state, held):
        again = {query.number for query in state.open if query.repeats is not None}
        return state.preferences.answers == 9 and held and set(held) <= again

    learner = by_two(10, one_left)
    (left,) = learner.state.open
    assert left.answerer == "Ada"
    learner.run(lambda first, second: "first", answerer="Ada")
    assert (learner.preferences.answers, learner.finished) == (10, True)


def test_who_comes_while_an_update_is_computed_lets_nobody_wait_for_it_again():
    learner = bayespbrl.Learner("gridworld", expert="other", **QUICK)
    ahead = Foresight(learner.cycle, learner.state, lambda *_: (None, tuple(Answer)), ["Ada"], several=True)
    computed = []
    while learner.state.iteration < 2:
        moment = ahead.present
        if moment.complete:
            number = next(iter(moment.holders))
            learner.record(events.answered(number, Answer.FIRST, answerer="Ada"))
            ahead.move(number, Answer.FIRST, learner.state)
            continue
        piece = ahead.compute(moment)
        if isinstance(piece, Entry):
            computed.append(piece.event["event"])
            if computed[-1] != "asked":  # another comes meanwhile, and leaves
                ahead.gather(["Ada", "Ben"])
                ahead.gather(["Ada"])
            assert ahead.current(moment, piece) is ahead.present
            learner.record(piece)
        ahead.keep(ahead.current(moment, piece), piece)
    assert [event for event in computed if event != "asked"] == ["collected", "improved"] * 2


def test_what_is_computed_changes_nothing_before_it_is_kept():
    """Another may answer meanwhile."""
    learner = bayespbrl.Learner("gridworld", expert="other", **QUICK)
    ahead = Foresight(learner.cycle, learner.state, lambda *_: (None, tuple(Answer)), NAMES, several=True)
    moment, kept = ahead.present, 0

    def known():
        return moment.state, dict(moment.holders), list(moment.entries), moment.settled, dict(moment.drawn)

    while not moment.complete:
        before = known()
        piece = ahead.compute(moment)
        assert all(now is was or now == was for now, was in zip(known(), before, strict=True))
        ahead.keep(moment, piece)
        kept += 1
    assert (kept, moment.settled, sorted(moment.drawn)) == (6, True, [1, 2])  # an event before each, and nothing more


def test_the_other_ones_question_cannot_be_answered(sitting):
    session, (ada, _), (ben, _) = sitting()
    settled(session)
    before = session.learner.log.log_file.read_bytes()
    with pytest.raises(Stale, match="turn: expected"):
        ben.answer(ada.view["turn"], "first")
    with pytest.raises(Stale, match="turn: expected one with a question"):
        ben.sheet(ada.view["turn"], 0)
    assert session.learner.log.log_file.read_bytes() == before
    assert ada.number != ben.number


def test_an_undo_takes_back_only_the_last_answer_and_no_question_that_another_looks_at(sitting):
    session, (ada, _), (ben, _) = sitting()
    settled(session)
    first = ada.number
    ada.answer(ada.view["turn"], "first")
    settled(session)
    assert (ada.view["undo"], ben.view["undo"]) == (True, False)
    with pytest.raises(ValueError, match="undo: expected an answer by the same person"):
        ben.answer(ben.view["turn"], "undo")
    ben_at = ben.number
    ada.answer(ada.view["turn"], "undo")
    settled(session)
    assert (ada.number, ben.number, session.learner.preferences.answers) == (first, ben_at, 0)
    ada.answer(ada.view["turn"], "second")
    settled(session)
    ben.answer(ben.view["turn"], "first")
    settled(session)
    assert (ada.view["undo"], ben.view["undo"]) == (False, True)
    assert [event["answer"] for event in logged(session.learner, "answered")] == ["first", "second", "first"]


def test_whoever_goes_away_holds_nobody_up_and_their_question_is_taken(sitting, monkeypatch):
    monkeypatch.setattr("bayespbrl.people.seat.AWAY", 0.0)
    session, (ada, leaves), (ben, _) = sitting()
    settled(session)
    left, turn = ada.number, ada.view["turn"]
    leaves()
    session.gather()
    taken = []
    while True:
        settled(session)
        if session.over:
            break
        taken.append(ben.number)
        ben.answer(ben.view["turn"], "first", 1.0)
    assert left in taken
    assert {event["answerer"] for event in logged(session.learner, "answered")} == {"Ben"}
    with pytest.raises(Stale):
        ada.answer(turn, "first")


def test_what_follows_the_last_answer_is_done_though_everybody_has_left(sitting, tmp_path, monkeypatch):
    monkeypatch.setattr("bayespbrl.people.seat.AWAY", 0.0)
    learner = bayespbrl.start("gridworld", tmp_path / "run", expert="page", answers=2, **LONGER)
    session, (ada, ada_leaves), (ben, ben_leaves) = sitting(learner)
    settled(session)
    ada.answer(ada.view["turn"], "first")
    settled(session)
    last = next(seat for seat in (ada, ben) if seat.view["phase"] == QUESTION)
    with session.changed:  # nothing is computed in between
        ada_leaves()
        ben_leaves()
        last.answer(last.view["turn"], "second")
        assert not learner.finished
    ada.wait((FINISHED, FAILED), WAIT)
    assert learner.finished
    assert learner.state.iteration > 1


def test_what_a_killed_program_leaves_is_asked_again_of_the_same_people(sitting, tmp_path):
    session, (ada, _), (ben, _) = sitting()
    for seat in (ada, ben, ada):
        settled(session)
        seat.answer(seat.view["turn"], "first", 1.0)
    settled(session)
    numbers = ada.number, ben.number
    shutil.copytree(tmp_path / "run", tmp_path / "left")
    learner = bayespbrl.resume(tmp_path / "left")
    assert {query.number for query in learner.state.open} == set(numbers)
    assert learner.preferences == session.learner.preferences
    again, (ada, _), (ben, _) = sitting(learner)
    settled(again)
    assert (ada.number, ben.number) == numbers
    again.close()
    queries = learner.ask()  # one person can go on too
    assert len(queries) == 2
    with pytest.raises(ValueError, match="undo"):
        learner.tell(["undo", "first"])
    learner.tell(["first", "tie"])
    assert learner.preferences.answers == 5


def test_a_sitting_of_several_ends_after_its_answers_and_asks_for_no_more(sitting):
    session, (ada, _), (ben, _) = sitting(most_answers=3)
    for seat in (ada, ben):
        settled(session)
        seat.answer(seat.view["turn"], "first")
    settled(session)
    phases = [seat.view["phase"] for seat in (ada, ben)]
    assert sorted(phases) == [QUESTION, WAITING]
    last = (ada, ben)[phases.index(QUESTION)]
    last.answer(last.view["turn"], "first")
    settled(session)
    assert {seat.view["phase"] for seat in (ada, ben)} == {FINISHED}
    assert session.learner.preferences.answers == 3


def test_a_sitting_of_one_answer_shows_one_of_the_questions_that_an_earlier_one_left_open(sitting):
    first, *_ = sitting()
    settled(first)
    first.close()
    assert len(first.learner.state.open) == 2
    session, (ada, _), (ben, _) = sitting(first.learner, most_answers=1)
    settled(session)
    asked, waits = (ada, ben) if ada.view["phase"] == QUESTION else (ben, ada)
    assert waits.view["phase"] == WAITING
    asked.answer(asked.view["turn"], "first")
    for seat in (ada, ben):
        seat.wait((FINISHED,), WAIT)
    assert session.learner.preferences.answers == 1


def answered_to_the_end(session, *sitters):
    """Both always say "first", the one and the other in turn: the answered questions by number, and the repeats."""
    turns = 0
    while True:
        settled(session)
        if session.over:
            break
        seat = [seat for seat, _ in sitters if seat.view["phase"] == QUESTION][:: (-1) ** turns][0]
        seat.answer(seat.view["turn"], "first")
        turns += 1
    past = {question.number: question for question in session.learner.state.past}
    return past, [question for question in past.values() if question.repeats is not None]


def test_a_question_is_repeated_to_the_person_who_answered_it(sitting):
    learner = bayespbrl.Learner("gridworld", expert="other", **QUICK | {"iterations": 8, "repeats": 0.3})
    past, again = answered_to_the_end(*sitting(learner))
    assert again
    assert all(question.answerer == past[question.repeats].answerer for question in again)


def test_shared_repeats_go_to_two_people_and_the_report_tells_how_well_they_agree(sitting, tmp_path):
    options = QUICK | {"iterations": 8, "repeats": 0.4, "shared_repeats": True}
    learner = bayespbrl.start("gridworld", tmp_path / "shared", expert="page", **options)
    past, again = answered_to_the_end(*sitting(learner))
    shared = [question for question in again if question.answerer != past[question.repeats].answerer]
    assert 0 < len(shared) <= len(again)
    figures = people(learner.state.past)
    assert figures["shared"].values.tolist() == [len(shared)] * 2
    assert figures["agreed"].values.tolist() == [0, 0]  # the sides were swapped, and both said "first"
    assert fingerprint(bayespbrl.load(learner.log.path).learner) == fingerprint(learner)
    report = bayespbrl.load(learner.log.path).report("md").read_text()
    assert f"0 of {len(shared)} (0 to " in report.split("same as others")[1]


def test_where_repeats_are_shared_one_that_waits_is_shown_to_whoever_is_there(tmp_path):
    options = QUICK | {"iterations": 8, "repeats": 0.3, "shared_repeats": True}
    learner = bayespbrl.start("gridworld", tmp_path / "left", expert="page", **options)
    while (query := learner.ask()[0]).repeats is None:
        learner.tell(["first"], answerer="Ada")
    assert alone(tmp_path / "left", "Bob", answers=1)[0] == [query.number]


@pytest.fixture
def repeat_waits(tmp_path):
    """The directory of a run that Ada left when a repeat of her question waited, and the number of the repeat."""
    options = QUICK | {"iterations": 8, "repeats": 0.3}
    learner = bayespbrl.start("gridworld", tmp_path / "left", expert="page", **options)
    while (query := learner.ask()[0]).repeats is None:
        learner.tell(["first"], answerer="Ada")
    return tmp_path / "left", query.number


def alone(directory, name, answers=None):
    """A sitting of one person, who always says "first": the numbers of the questions, and those that then wait."""
    learner = bayespbrl.resume(directory)
    session, numbers = Session(learner, answerer=name, most_answers=answers).open(), []
    try:
        while (view := session.wait(timeout=WAIT))["phase"] == QUESTION:
            numbers.append(session.seats[0].number)
            session.answer(view["turn"], "first")
        assert view["phase"] == FINISHED
    finally:
        session.close()
    assert fingerprint(bayespbrl.load(directory).learner) == fingerprint(learner)
    return numbers, [query.number for query in learner.state.open]


def test_a_waiting_repeat_is_not_shown_to_another_person_alone_and_waits_for_whoever_is_meant(repeat_waits):
    directory, number = repeat_waits
    answered, waiting = alone(directory, "Bob", answers=2)
    assert number not in answered
    assert answered[0] == number + 1
    assert number in waiting
    assert alone(directory, "Ada", answers=2)[0][0] == number
    alone(directory, "Bob")
    past = {question.number: question for question in bayespbrl.load(directory).learner.state.past}
    assert past[number].answerer == "Ada"
    again = [question for question in past.values() if question.repeats is not None]
    assert all(question.answerer == past[question.repeats].answerer for question in again)


def test_a_run_ends_though_a_repeat_waits_for_somebody_who_has_left(repeat_waits):
    directory, number = repeat_waits
    answered, waiting = alone(directory, "Bob")
    assert number not in answered
    assert number in waiting
    assert bayespbrl.load(directory).learner.finished


def test_nobody_is_shown_a_repeat_that_was_left_open_once_the_budget_is_spent(repeat_waits):
    directory, number = repeat_waits
    learner = bayespbrl.resume(directory)
    given, settings = learner.preferences.answers, learner.cycle.settings

    def shown_to(budget):
        cycle = replace(
            learner.cycle, settings=replace(settings, questions=replace(settings.questions, answers=budget))
        )
        return Foresight(cycle, learner.state, lambda state, query: None, ["Ada", "Ben"], several=True).present.holders

    assert shown_to(given + 1) == {number: "Ada"}
    assert shown_to(given) == {}


def test_a_person_at_the_terminal_is_not_asked_a_repeat_that_waits_for_another(repeat_waits):
    directory, number = repeat_waits
    shutil.copytree(directory, directory.parent / "again")
    bob = bayespbrl.resume(directory).run(lambda first, second: "first", answerer="Bob")
    assert bob.finished
    assert [query.number for query in bob.state.open] == [number]
    assert {past.answerer for past in bob.state.past if past.number > number} == {"Bob"}
    ada = bayespbrl.resume(directory.parent / "again").run(lambda first, second: "first", answerer="Ada")
    assert {past.answerer for past in ada.state.past if past.number >= number} == {"Ada"}
    assert fingerprint(bayespbrl.load(directory).learner) == fingerprint(bob)


def test_whoever_gives_no_name_is_shown_the_question_that_waits(repeat_waits):
    directory, number = repeat_waits
    assert alone(directory, None, answers=1)[0] == [number]


@pytest.mark.parametrize("names", [["Ada", "Ada"], ["Ada", ""], []])
def test_bad_names_are_refused(names):
    with pytest.raises(ValueError, match="answerer: expected"):
        Session(bayespbrl.Learner("gridworld", expert="other", **QUICK), answerer=names)


def test_the_command_line_refuses_a_name_twice_and_two_at_the_terminal(monkeypatch, capsys, tmp_path):
    for options in (["page", "--answerer", "Ada"], ["terminal", "--answerer", "Ben"]):
        arguments = ["run", "gridworld", "--answerer", "Ada", "--expert", *options, "--out", str(tmp_path / "new")]
        monkeypatch.setattr("sys.argv", ["bayespbrl", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        assert (stop.value.code, capsys.readouterr().err.count("\n")) == (2, 1)
    assert not (tmp_path / "new").exists()


def test_an_answer_about_an_incumbent_that_has_fallen_is_about_the_two_alone():
    before = Preferences(undominated=(0,)).add(1, 0, preferred=1)  # meanwhile another was asked about 2 and 0
    assert before.add(2, 0, preferred=2, rivals=[0]).undominated == (1, 2)
    worse, tie = before.add(2, 0, preferred=0, rivals=[0]), before.add(2, 0, preferred=None, rivals=[0])
    assert (worse.pairs, worse.undominated) == (((1, 0), (0, 2)), (1,))
    assert (tie.ties, tie.undominated) == (((2, 0),), (1,))


def test_an_answer_about_a_newcomer_that_has_fallen_does_not_raise_it_again():
    before = Preferences(undominated=(3,)).add(4, 0, preferred=4, rivals=[])  # 0 was the opponent of 4
    better = before.add(0, 1, preferred=0, rivals=[])
    assert (better.pairs, better.undominated) == (((4, 0), (0, 1)), (3, 4))
    assert before.add(0, 1, preferred=1, rivals=[]).undominated == (3, 4)
    tie = before.add(0, 1, preferred=None, rivals=[])
    assert (tie.ties, tie.undominated) == (((0, 1),), (3, 4))
    assert before.add(0, 4, preferred=0, rivals=[4]).undominated == (3,)  # contradicted: neither is undominated


def test_a_newcomer_that_has_become_undominated_meanwhile_is_there_once():
    before = Preferences(undominated=(3,)).add(4, 0, preferred=0, rivals=[])
    assert before.add(0, 1, preferred=0, rivals=[]).undominated == (3, 0)
    assert before.add(0, 1, preferred=1, rivals=[]).undominated == (3, 1)
    assert before.add(0, 1, preferred=None, rivals=[]).undominated == (3, 1, 0)
    assert before.add(0, 3, preferred=0, rivals=[3, 0]).pairs == ((0, 4), (0, 3))
    # answers in a circle: somebody has to be compared with
    circle = (
        Preferences(undominated=(0,)).add(1, 0, preferred=1).add(2, 1, preferred=2).add(0, 2, preferred=0, rivals=[2])
    )
    assert circle.undominated == (2,)


def test_only_those_that_ties_connect_compete_with_a_newcomer():
    standing = Preferences(undominated=(0, 1, 2, 3), ties=((1, 0), (3, 1), (5, 2)))
    assert standing.tied_with(3) == (0, 1, 3)
    assert standing.tied_with(2) == (2,)
    chain = Preferences(undominated=(0, 1, 2, 3), ties=((2, 3), (1, 2), (0, 1)))
    assert chain.tied_with(0) == chain.tied_with(3) == (0, 1, 2, 3)


@pytest.mark.slow
def test_two_people_in_two_browsers_answer_a_run_and_cannot_answer_for_each_other(browser, tmp_path):
    learner = bayespbrl.start("gridworld", tmp_path / "run", expert="page", **LONGER)
    with served(learner, answerer=NAMES) as page:
        home = page.addresses
        tokens = [address.rstrip("/").rpartition("/")[2] for address in home]
        assert len(set(tokens)) == 2
        with (
            closing(_Tab(browser, page, home[0])) as ada,
            closing(_Tab(browser, page, home[1])) as ben,
        ):
            assert "answered by Ada" in ada.opened.inner_text(".bp-task")
            assert "answered by Ben" in ben.opened.inner_text(".bp-task")
            settled(page.session)
            before = learner.log.log_file.read_bytes()
            body = json.dumps({"turn": turn_of(ada.opened), "answer": "first"})
            assert call(page, "POST", f"/{tokens[1]}/answer", body)[0] == 409
            assert call(page, "GET", f"/{tokens[1]}/clip/{turn_of(ada.opened)}/0")[0] == 404
            assert learner.log.log_file.read_bytes() == before
            turns, given = [], 0
            people = [ada, ben]
            while "finished" not in (phases := [person.phase for person in people]):
                person = people[given % 2] if phases[given % 2] == "question" else people[1 - given % 2]
                turns.append(turn_of(person.opened))
                person.opened.keyboard.press(KEYS[("first", "second")[given % 2]])
                next_turn(person.opened, turns[-1], ".bp-box[data-phase=waiting]")
                given += 1
            assert len(set(turns)) == len(turns)
    answered = logged(learner, "answered")
    assert len(answers_of(page)) == given
    assert {event["answerer"] for event in answered} == set(NAMES)


class _Tab:
    """A tab on one person's address."""

    def __init__(self, browser, page, address):
        self._context = tab(browser, page, address=address)
        self.opened = self._context.__enter__()

    @property
    def phase(self):
        return self.opened.get_attribute(".bp-box", "data-phase")

    def close(self):
        self._context.__exit__(None, None, None)
