"""Answers of people: who gave each, how long it took, and what is kept of it."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from toys import QUICK, Memory, fingerprint

from bayespbrl import (
    Answer,
    Learner,
    Preferences,
    ReturnExpert,
    infer_utility,
    load,
    read_answers,
    read_questions,
    resume,
    start,
)
from bayespbrl.diagnostics import people
from bayespbrl.diagnostics.estimates import predicted_answer
from bayespbrl.diagnostics.report import document as report_document
from bayespbrl.diagnostics.report.contents import read_contents
from bayespbrl.diagnostics.report.people import people_warnings
from bayespbrl.diagnostics.report.write import write_report
from bayespbrl.events import Entry, LearnerState, apply
from bayespbrl.models import Answers, PreferenceModel, posterior_draws, sample_posterior
from bayespbrl.models.posterior_tree import utility_margins
from bayespbrl.people.views import said_of
from bayespbrl.preferences import PastQuestion, Source
from bayespbrl.questions import LEAST_BETWEEN, Questions, repeated
from bayespbrl.runs.answers_file import write_answers
from bayespbrl.utility.comparisons import Comparisons

OPTIONS = QUICK | {"iterations": 2}


def remembered(**changes):
    log = Memory()
    return Learner("gridworld", **(OPTIONS | changes)).logged(log), log


def test_who_answered_and_how_long_it_took_is_in_the_log():
    run, log = remembered()
    run.ask()
    run.tell(["first"], answerer="Ada", seconds=2.5)
    run.tell(["skip"], answerer="Böb 2", seconds=0)
    run.tell(["tie"])
    assert log.answers() == [
        {"event": "answered", "query": 1, "answer": "first", "answerer": "Ada", "seconds": 2.5},
        {"event": "answered", "query": 2, "answer": "skip", "answerer": "Böb 2", "seconds": 0.0},
        {"event": "answered", "query": 3, "answer": "tie"},
    ]
    assert {row.answerer for row in run.preferences.rows()} - {None} == {"Ada"}
    assert run.preferences.answerers == ("Ada", None)
    assert run.preferences.answers == 2  # who cannot tell has not answered


@pytest.mark.parametrize("answerer", ["", " ", "a ", "a\nb", "\x07", "x" * 65, 3, b"Ada", ["Ada"]])
def test_a_bad_name_is_refused_and_nothing_has_happened(answerer):
    run, log = remembered()
    run.ask()
    state, length = run.state, len(log.entries)
    with pytest.raises(ValueError, match=r"answerer: expected a printable name of 1 to 64 characters, got"):
        run.tell(["first"], answerer=answerer)
    assert (run.state, len(log.entries)) == (state, length)
    with pytest.raises(ValueError, match="answerer: expected a printable name"):
        apply(state, Entry({"event": "answered", "query": 1, "answer": "tie", "answerer": answerer}))


@pytest.mark.parametrize("seconds", [-1, float("nan"), float("inf"), "3", True, [1.0], np.timedelta64(2, "s")])
def test_a_bad_response_time_is_refused_and_nothing_has_happened(seconds):
    run, log = remembered()
    run.ask()
    with pytest.raises(ValueError, match=r"seconds: expected a non-negative finite number, got"):
        run.tell(["first"], answerer="Ada", seconds=seconds)
    assert log.answers() == []
    assert run.ask()[0].number == 1


@pytest.mark.parametrize("replays", [-1, 1.5, "2", True, 10_001])
def test_a_number_of_replays_that_is_none_is_refused(replays):
    run, _ = remembered()
    run.ask()
    event = {"event": "answered", "query": 1, "answer": "tie"}
    with pytest.raises(ValueError, match="replays: expected"):
        apply(run.state, Entry(event | {"replays": replays}))
    kept = apply(run.state, Entry(event | {"replays": 10_000, "session": "monday"})).past[-1]
    assert (kept.session, kept.replays, kept.seconds) == ("monday", 10_000, None)
    with pytest.raises(ValueError, match="session: expected a printable name"):
        apply(run.state, Entry(event | {"session": ""}))


def test_an_undo_says_whose_it_is(tmp_path):
    run, log = remembered()
    run.ask()
    run.tell(["first"], answerer="Ada")
    with pytest.raises(ValueError, match="answerer: expected a printable name"):
        run.undo(answerer="")
    run.tell(["undo"], answerer="Ada")
    assert log.entries[-1].event == {"event": "undone", "answerer": "Ada"}


def test_a_named_person_who_answers_in_a_loop_is_timed_and_a_simulated_expert_is_not():
    run, log = remembered()
    run.run(ReturnExpert(), answerer="Ada")
    assert all(event["answerer"] == "Ada" and event["seconds"] >= 0 for event in log.answers())
    plain, plain_log = remembered()
    plain.run(ReturnExpert())
    assert all(set(event) == {"event", "query", "answer"} for event in plain_log.answers())
    assert fingerprint(plain)["policy"] == fingerprint(run)["policy"]  # one answerer changes nothing


def test_a_run_on_disk_replays_who_answered(tmp_path):
    run = start("gridworld", tmp_path / "run", **OPTIONS)
    run.ask()
    run.tell(["first"], answerer="Ada", seconds=1)
    run.tell(["second"], answerer="Bob", seconds=2)
    again = resume(tmp_path / "run")
    assert again.preferences == run.preferences
    assert again.preferences.answerers == ("Ada", "Bob")
    lines = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert [line["seconds"] for line in lines if line["event"] == "answered"] == [1.0, 2.0]


def test_all_that_follows_from_an_answer_is_its_answerers_and_only_what_was_shown_has_a_side():
    before = Preferences(undominated=(0, 2), answers=2)
    after = before.add(7, 2, preferred=7, shown_first=2, answerer="Ada").add(
        8, 7, preferred=None, shown_first=8, answerer="Bob"
    )
    assert (after.pairs, after.ties) == (((7, 0), (7, 2)), ((8, 7),))
    assert after.rows() == [
        Source(False, 0, 0, "Ada"),
        Source(False, 1, -1, "Ada"),
        Source(True, 0, 1, "Bob"),
    ]


def test_several_answerers_are_numbered_by_their_first_answer_and_nobody_without_a_name_is():
    trajectories, pairs = [object()] * 4, [(0, 1), (2, 1), (3, 0)]
    several = Comparisons.among(trajectories, pairs, discount=1.0, answered_by=["Bob", "Ada", "Bob"])
    checked = several.answers.checked(3)
    assert (checked.answerers.tolist(), checked.names) == ([0, 1, 0], ("Bob", "Ada"))
    one = Comparisons.among(trajectories, pairs, discount=1.0, answered_by=["Bob"] * 3).answers.checked(3)
    assert (one.answerers.tolist(), one.names) == ([0, 0, 0], ("Bob",))
    nobody = Comparisons.among(trajectories, pairs, discount=1.0, answered_by=[""] * 3)
    assert nobody.answers == Comparisons.among(trajectories, pairs, discount=1.0).answers


def test_a_missing_name_as_tables_have_it_is_refused_and_names_of_any_sequence_are_taken():
    with pytest.raises(ValueError, match="expected 3 names, one for each answer and '' for a person without"):
        Answers(answerers=["Ada", float("nan"), "Ben"]).checked(3)
    for names in (("Ada", "", "Ben"), np.array(["Ada", "", "Ben"])):
        assert Answers(answerers=names).checked(3).names == ("Ada", "", "Ben")


def test_names_without_who_gave_which_answer_are_refused():
    with pytest.raises(ValueError, match="answerers: expected who of Ada gave each answer, got None"):
        posterior_draws(np.ones((2, 1)), PreferenceModel(), seed=0, answers=Answers(names=("Ada",)))


def test_nobody_has_answered_a_new_run_and_an_answer_without_a_name_is_somebodys():
    assert LearnerState.begun("policy").preferences.answerers == ()
    assert Preferences(answers=1).answerers == (None,)


def answering(run, choose, number=100, **who):
    """Answer at most `number` questions by `choose`, and return them."""
    asked = []
    while len(asked) < number and (questions := run.ask(answerer=who.get("answerer"))):
        asked.append(questions[0])
        run.tell([choose(questions[0])], **who)
    return asked


def always_the_first(query):
    return "first"


PEOPLE = OPTIONS | {"expert": "other", "iterations": 12, "max_steps": 5, "evaluation_episodes": 1}


def test_a_share_of_the_questions_is_an_earlier_one_with_sides_swapped_and_its_answer_is_one_more():
    run, _ = remembered(**PEOPLE, repeats=0.25)
    asked = answering(run, always_the_first, answerer="Ada")
    repeats = [query for query in asked if query.repeats is not None]
    assert len(asked) == 13 + len(repeats)  # what an iteration wants is asked beside them
    assert len(repeats) == len(asked) // 4
    assert len({query.repeats for query in repeats}) == len(repeats)  # each once
    for query in repeats:
        earlier = asked[query.repeats - 1]
        assert earlier.repeats is None
        assert (query.first, query.second) == (earlier.second, earlier.first)
        assert query.trajectories == earlier.trajectories[::-1]
        assert query.number - earlier.number > LEAST_BETWEEN
        # whoever always chooses the first contradicts themselves: both answers are data
        assert {(earlier.first, earlier.second), (query.first, query.second)} <= set(run.preferences.pairs)
    assert run.preferences.answers == len(asked)
    sides = [source.side for source in run.preferences.rows()]
    assert set(sides) <= {1, 0}
    assert sides.count(1) == len(asked)


def test_repeated_questions_replay_and_undo(tmp_path):
    straight = Learner("gridworld", **PEOPLE, repeats=0.25)
    answering(straight, always_the_first)
    run = start("gridworld", tmp_path / "run", **PEOPLE, repeats=0.25)
    while (question := run.ask()[0]).repeats is None:
        run.tell(["first"])
    run.tell(["tie"])
    assert run.preferences.ties[-1] == (question.first, question.second)
    again = resume(tmp_path / "run")
    assert (again.preferences, again.state.past) == (run.preferences, run.state.past)
    again.undo()
    (waiting,) = again.ask()
    assert (waiting.number, waiting.first, waiting.repeats) == (question.number, question.first, question.repeats)
    answering(again, always_the_first)
    assert fingerprint(again) == fingerprint(straight)


def test_a_repeated_question_that_nobody_can_answer_costs_nothing():
    run, _ = remembered(**PEOPLE, repeats=0.25)
    asked = answering(run, lambda query: "first" if query.repeats is None else "skip")
    skipped = [query for query in asked if query.repeats is not None]
    assert skipped
    assert run.preferences.answers == 13 == len(asked) - len(skipped)


def test_repeated_questions_stay_within_the_budget_and_are_of_the_one_who_answers():
    run, _ = remembered(**PEOPLE, repeats=0.4, answers=9)
    answering(run, always_the_first, 5, answerer="Ada")
    asked = answering(run, always_the_first, 5, answerer="Bob")
    assert run.preferences.answers == 9
    past = {question.number: question for question in run.state.past}
    later = [query for query in asked[1:] if query.repeats is not None]
    assert all(past[query.repeats].answerer == "Bob" for query in later)


def test_people_who_take_turns_are_asked_again_what_they_answered_themselves():
    run, _ = remembered(**PEOPLE, repeats=0.3, answers=24)
    names = {}
    while questions := run.ask(answerer=(name := ("Ada", "Ben")[len(names) % 2])):
        (query,) = questions
        names[query.number] = name
        if query.repeats is not None:
            assert names[query.repeats] == name
        run.tell(["first"], answerer=name)
    assert {past.number: past.answerer for past in run.state.past} == names
    assert len(names) > 12
    repeats = [past.answerer for past in run.state.past if past.repeats is not None]
    assert {"Ada", "Ben"} == set(repeats)


def test_an_answer_to_a_question_that_waits_for_another_person_is_refused():
    run, _ = remembered(**PEOPLE, repeats=0.3, answers=24)
    while run.ask()[0].repeats is None:
        run.tell(["first"], answerer="Ada")
    with pytest.raises(
        ValueError, match=r"tell: expected a list of 0 answers, one to each of ask\(answerer='Ben'\) \(no"
    ):
        run.tell(["first"], answerer="Ben")
    (query,) = run.ask(answerer="Ben")
    assert query.repeats is None
    repeated, _ = run.ask()
    with pytest.raises(ValueError, match=rf"got number {repeated.number}, where {query.number} waits"):
        run.tell(["second"], queries=[repeated], answerer="Ben")
    run.tell(["second"], queries=[query], answerer="Ben")
    assert run.state.past[-1].number == query.number
    assert run.ask(answerer="Ada")[0].repeats is not None
    with pytest.raises(ValueError, match="answerer: expected"):
        run.ask(answerer=" ")


def test_of_several_people_nobody_is_asked_again_what_they_were_asked_just_now():
    names = ["Ada", "Ada", *3 * ["Ben"], "Ada", *3 * ["Ben"]]
    past = [PastQuestion(n, 0, n, n, None, Answer.FIRST, who, None) for n, who in enumerate(names, start=1)]
    options, rng = Questions(repeats=0.5), np.random.default_rng(0)

    def of(person):
        return {repeated(past, 10, options, left=10, rng=rng, answerer=person) for _ in range(50)}

    assert of("Ada") == {None}  # 1, 2 and 6 are her last three, though others came between
    assert {one.number for one in of("Ben")} == {3, 4, 5}


def test_where_repeats_are_shared_nobody_is_asked_what_others_were_asked_just_now():
    past = [PastQuestion(n, 0, n, n, None, Answer.FIRST, "Ada", None) for n in range(1, 9)]
    options, rng = Questions(repeats=0.5, shared_repeats=True), np.random.default_rng(0)
    again = {repeated(past, 9, options, left=9, rng=rng, answerer="Ben").number for _ in range(100)}
    assert again == {1, 2, 3, 4, 5}  # the last three are too fresh, though Ben has answered none


def test_a_question_that_is_being_repeated_to_somebody_is_not_repeated_to_another():
    past = [PastQuestion(n, 0, n, n, None, Answer.FIRST, "Ada", None) for n in range(1, 9)]
    options, rng = Questions(repeats=0.2, shared_repeats=True), np.random.default_rng(0)
    for waiting in [(), (1,), (None, 2)]:
        again = {repeated(past, 10, options, left=10, rng=rng, answerer="Ben", waiting=waiting) for _ in range(50)}
        assert not {one.number for one in again} & set(waiting)
    assert repeated(past, 10, options, left=10, rng=rng, answerer="Ben", waiting=(1, 2)) is None  # a fifth of ten


def test_people_are_asked_a_tenth_again_and_wait_for_no_silent_iteration():
    people, simulated = (Learner("gridworld", expert=expert).settings for expert in ("other", "return"))
    assert people.questions.repeats == 0.1
    assert (people.questions.unasked_iterations, simulated.questions.unasked_iterations) == (0, 4)
    assert (people.questions.worthwhile, simulated.questions.worthwhile) == (False, True)
    assert (people.rollouts.evaluation_episodes, simulated.rollouts.evaluation_episodes) == (20, 100)
    assert Learner("gridworld", expert="terminal", repeats=0.0).settings.questions.repeats == 0
    assert Learner("gridworld").settings.questions.repeats == 0
    with pytest.raises(ValueError, match=r"repeats: expected a number in \[0, 1\), got 1"):
        Learner("gridworld", repeats=1)


def test_what_repeats_no_earlier_question_is_refused():
    run, _ = remembered()
    answering(run, always_the_first, 1)
    (first,) = run.state.past
    waiting = run.ask()[0].number
    event = {"event": "asked", "query": waiting, "first": first.first, "second": first.second, "newcomer": first.first}
    with pytest.raises(ValueError, match="asked: expected a question that was asked before with sides swapped"):
        apply(run.state, Entry(event | {"repeats": first.number}))


# By hand: Ada is asked twice again and says the same once; Bob ties, cannot tell, and is asked a question of hers.
PAST = (
    PastQuestion(1, 0, 1, 1, None, Answer.FIRST, "Ada", 2.0),
    PastQuestion(2, 2, 3, 3, None, Answer.SECOND, "Ada", 4.0),
    PastQuestion(3, 4, 5, 5, None, Answer.TIE, "Bob", None),
    PastQuestion(4, 6, 7, 7, None, Answer.SKIP, "Bob", 0.5),
    PastQuestion(5, 1, 0, 1, 1, Answer.SECOND, "Ada", 3.0),
    PastQuestion(6, 3, 2, 3, 2, Answer.SECOND, "Ada", 9.0),
    PastQuestion(7, 1, 0, 1, 1, Answer.FIRST, "Bob", 1.5),
)


def test_the_figures_of_each_person_by_hand():
    table = people(PAST)
    assert table["answerer"].values.tolist() == ["Ada", "Bob"]
    assert table["answers"].values.tolist() == [4, 2]
    assert table["ties"].values.tolist() == [0, 1]
    assert table["cannot_tell"].values.tolist() == [0, 1]
    assert table["repeated"].values.tolist() == [2, 0]  # what another answered before says nothing of Bob
    assert table["consistent"].values.tolist() == [1, 0]
    assert table["shared"].values.tolist() == [1, 1]  # 1, which Bob answered the other way round
    assert table["agreed"].values.tolist() == [0, 0]
    np.testing.assert_allclose(table["agreement_upper"].values, 0.95, atol=1e-9)  # the root of 1 - p = 0.05
    assert table["seconds"].values.tolist() == [3.5, 1.0]
    # Clopper and Pearson's interval of 1 of 2 at 90 %: the roots of (1 - p)² = 0.95 and p² = 0.95
    lower, upper = 1 - np.sqrt(0.95), np.sqrt(0.95)
    np.testing.assert_allclose(table["consistency_lower"].values, [lower, 0], atol=1e-9)
    np.testing.assert_allclose(table["consistency_upper"].values, [upper, 1], atol=1e-9)
    assert np.isnan(table["lapse_rate"]).all()
    assert people(()).sizes["answerer"] == 0


@pytest.mark.parametrize(
    ("number", "place"),
    [(0, None), (4, None), (5, 1), (7, 1), (8, 2), (20, 6), (100, 42)],  # tables of the sign test at 10 %, two-sided
)
def test_the_interval_of_a_median_time_is_that_of_the_sign_test(number, place):
    times = np.random.default_rng(0).permutation(np.arange(1.0, number + 1))
    past = [PastQuestion(k, 0, 1, 1, None, Answer.FIRST, "Ada", seconds) for k, seconds in enumerate(times)]
    table = people([*past, PastQuestion(999, 0, 1, 1, None, Answer.FIRST, "Ada", None)])
    found = [float(table[f"seconds_{end}"][0]) for end in ("lower", "upper")]
    np.testing.assert_equal(found, [np.nan] * 2 if place is None else [place, number + 1 - place])


def test_lapse_rates_and_biases_are_each_persons_own():
    differences = np.array([[1.0], [0.8], [-0.6], [0.5], [-0.9], [0.7]])
    who, sides = ["Bob", "Ada", "Bob", "Ada", "Bob", "Ada"], np.array([1, -1, 1, 1, 1, -1])
    tree = sample_posterior(differences, lapse_rate=None, shown_first=sides, answerers=who, num_samples=100)
    table = people(PAST, tree)
    for place, name in enumerate(("Ada", "Bob")):
        for quantity in ("lapse_rate", "side_bias"):
            draws = tree["posterior"][quantity].sel(answerer=name).values
            found = [float(table[f"{quantity}{end}"][place]) for end in ("", "_lower", "_upper")]
            np.testing.assert_allclose(found, [draws.mean(), *np.quantile(draws, [0.05, 0.95])])
    assert table["lapse_rate"][1] > table["lapse_rate"][0]  # Bob contradicts the others


@pytest.mark.slow
def test_the_habits_of_the_only_person_so_far_are_not_ascribed_to_another():
    """Ada takes the first shown ten times; what is said of a question counts this for her alone."""
    options = QUICK | {"utility": "posterior-mean", "hyperparameters": "inferred", "expert": "other", "repeats": 0}
    learner = Learner("gridworld", **options | {"iterations": 11})
    for _ in range(10):
        learner.ask()
        learner.tell(["first"], answerer="Ada")
    (query,) = learner.ask()
    estimate, (first, second) = learner.estimate, query.trajectories
    shown, other_way = (
        {name: predicted_answer(estimate, *both, answerer=name)[0] for name in ("Ada", "Bob")}
        for both in ((first, second), (second, first))
    )
    assert shown["Bob"] == pytest.approx(1 - other_way["Bob"], abs=1e-9)
    assert shown["Ada"] + other_way["Ada"] > 1.2
    for name in ("Ada", "Bob"):
        said = said_of(query, learner.state, name)[0]
        assert said["sure"] == pytest.approx(max(shown[name], 1 - shown[name]), abs=0.03)
    (of_ada, likely), (of_bob, _) = (said_of(query, learner.state, name) for name in ("Ada", "Bob"))
    assert likely[0] is Answer.FIRST
    assert of_ada["sure"] > of_bob["sure"] + 0.1
    assert of_ada["worth"] == of_bob["worth"]


@pytest.mark.slow
def test_who_answered_after_the_last_fit_has_no_lapse_rate_yet():
    tree = sample_posterior(np.array([[1.0], [0.8]]), lapse_rate=None, num_samples=100)  # Ada's answers alone
    table = people(PAST, tree)
    assert float(table["lapse_rate"].sel(answerer="Ada")) == tree["posterior"]["lapse_rate"].values.mean()
    assert np.isnan(float(table["lapse_rate"].sel(answerer="Bob")))


@pytest.fixture(scope="module")
def answered_by_two(tmp_path_factory) -> Path:
    """A run of two people: Ada knows what is better, Bob always takes the first at once."""
    directory = tmp_path_factory.mktemp("people") / "run"
    options = {"preset": "paper", "hyperparameters": "inferred", "max_steps": 20, "evaluation_episodes": 2, "seed": 7}
    run = start("gridworld", directory, **options, expert="other", repeats=0.25, iterations=6, first_queries=9)
    turn = 1
    while questions := run.ask(answerer="Bob" if turn > 7 else "Ada"):
        if turn > 7:  # before the first fit: one program samples all posteriors
            run.tell(["first"], answerer="Bob", seconds=0.2)
        else:
            run.tell([ReturnExpert()(*questions[0].trajectories)], answerer="Ada", seconds=5.0)
        turn += 1
    return directory


@pytest.mark.slow
def test_the_report_of_a_run_of_people_says_what_to_do_about_each(answered_by_two, monkeypatch):
    monkeypatch.setattr(report_document, "_few_colours", lambda *a, **o: b"\x89PNG")  # the text alone is read
    text = write_report(answered_by_two, format="md").read_text()
    head, section = text[: text.index("## Learning curve")], text[text.index("## People") :]
    section = section[: section.index("\n## ")]
    rows = {line.split("|")[1].strip(): line for line in section.splitlines() if line.startswith("|")}
    assert {"Ada", "Bob"} <= set(rows)
    assert "| 5.0 s (5.0 to 5.0) |" in rows["Ada"]
    found = [warning.what for warning in people_warnings(read_contents(answered_by_two))]
    assert all(what in head and what in section for what in found)
    assert "Bob favours the trajectory shown first." in found
    assert any(what.startswith("Bob took 0.2 s in the median") for what in found)
    assert not any(what.startswith("Ada") for what in found)


def advised(past, lapse_rates, *, given=None):
    """The advice on each person, by the draws of their lapse rates; `given` is one that was set."""
    drawn = {"lapse_rate": (("chain", "draw", "answerer"), [np.transpose(list(lapse_rates.values()))])}
    posterior = xr.DataTree.from_dict({"/posterior": xr.Dataset(drawn, coords={"answerer": list(lapse_rates)})})
    warnings = people_warnings(SimpleNamespace(past=past, posterior=posterior, model=PreferenceModel(lapse_rate=given)))
    return [(warning.what, warning.remedy) for warning in warnings]


def test_whoever_mostly_tosses_coins_is_to_be_dropped_and_who_often_does_to_be_trusted_less():
    surely, often, never = [0.6, 0.7, 0.8], [0.2, 0.3, 0.4], [0.0, 0.1, 0.3]
    answers = [PastQuestion(k, 0, 1, 1, None, Answer.FIRST, name, 5.0) for k, name in enumerate(("Ada", "Bob", "Cy"))]
    drop, trust = advised(answers, {"Ada": surely, "Bob": often, "Cy": never})
    assert drop[0].startswith("Ada: 70 % of the answers look random")
    assert drop[1] == "Drop them. run.estimate_without('Ada') infers the utility without them."
    assert trust[0].startswith("Bob: 30 % of the answers look random")
    assert trust[1].startswith("The posterior already trusts them less.")
    assert [remedy for _, remedy in advised(answers[:1], {"Ada": surely})] == ["Start a new run with someone else."]
    assert advised(answers, {"Ada": surely, "Bob": often, "Cy": never}, given=0.7) == []  # no answer decided on it
    (unnamed, *_) = advised([answers[0]._replace(answerer=None), answers[1]], {"": surely, "Bob": never})
    assert unnamed[1] == "Drop them. run.estimate_without(None) infers the utility without them."


def test_a_posterior_of_several_people_without_their_names_tells_nothing_about_one():
    past = [PastQuestion(n, 0, 1, 1, None, Answer.FIRST, who, None) for n, who in enumerate(("Ada", "Bob", "Ada"), 1)]
    pairs = [(0, 1), (1, 2), (0, 2)]
    pooled, first, named = (
        people(past, infer_utility(np.eye(3), pairs[:number], answerers=names).posterior)["lapse_rate"].values
        for number, names in ((3, None), (1, None), (3, ["Ada", "Bob", "Ada"]))
    )
    assert np.isnan(pooled).all()
    assert np.isnan(first).tolist() == [False, True]  # before Bob's answer was used
    assert np.isfinite(named).all()
    with pytest.raises(ValueError, match="tree: expected a posterior"):
        people(past, infer_utility(np.eye(3), pairs))


def test_whoever_contradicts_themselves_is_asked_again_and_who_cannot_tell_is_shown_more():
    both = [PastQuestion(k, 0, 1, 1, None, Answer.FIRST, "Ada", 5.0) for k in range(4)]
    both += [PastQuestion(9 + k, 1, 0, 1, k, Answer.FIRST, "Ada", 5.0) for k in range(4)]  # the other one, each time
    assert advised(both, {"Ada": [0.0, 0.1]}) == [
        (
            "Ada: only 0 of 4 repeated questions were answered as before.",
            "Ask again, with clearer instructions or longer trajectories.",
        )
    ]
    unsure = [PastQuestion(20 + k, 0, 1, 1, None, Answer.SKIP, "Ada", 5.0) for k in range(2)]
    for number, said in ((1, []), (2, ["Ada could not tell in 2 of 5 questions."])):
        assert [what for what, _ in advised(both[:3] + unsure[:number], {"Ada": [0.0, 0.1]})] == said


def test_a_run_of_the_simulated_expert_has_no_section_on_people(tmp_path, monkeypatch):
    monkeypatch.setattr(report_document, "_few_colours", lambda *a, **o: b"\x89PNG")
    start("gridworld", tmp_path / "run", **OPTIONS).run(ReturnExpert())
    assert "## People" not in write_report(tmp_path / "run", format="md").read_text()


@pytest.mark.slow
def test_a_lapse_rate_that_was_set_has_no_interval_in_the_report(tmp_path, monkeypatch):
    monkeypatch.setattr(report_document, "_few_colours", lambda *a, **o: b"\x89PNG")
    run = start("gridworld", tmp_path / "run", **(OPTIONS | {"utility": "posterior-mean", "iterations": 1}))
    run.run(ReturnExpert(), answerer="Ada")
    text = write_report(tmp_path / "run", format="md").read_text()
    assert "| 0 (set) | – | – |" in text  # a simulated expert favours no side


@pytest.mark.slow
def test_the_utility_without_one_person_is_that_of_the_others(answered_by_two):
    run = load(answered_by_two)
    assert run.preferences.answerers == ("Ada", "Bob")
    left = run.preferences.without("Bob")
    assert left.answerers == ("Ada",)
    assert left.answers == sum(q.answerer == "Ada" and q.answer is not Answer.SKIP for q in run.learner.state.past)
    assert all(left.pairs[source.number] in run.preferences.pairs for source in left.sources if not source.tied)
    estimate = run.estimate_without("Bob")
    assert estimate.quality.pairs == len(left.pairs)
    assert estimate.posterior["posterior"].coords["answerer"].values.tolist() == ["Ada"]
    with pytest.raises(ValueError, match="answerer: expected one of 'Ada', 'Bob', got 'Eve'"):
        run.estimate_without("Eve")


@pytest.mark.slow
def test_the_answers_of_a_run_as_a_table_and_back(answered_by_two):
    run = load(answered_by_two)
    file = run.write_answers()
    assert file == answered_by_two / "preferences.csv"
    lines = file.read_text().splitlines()
    assert lines[0] == "question,first,second,answer,answerer,seconds,repeats,session,replays"
    assert len(lines) == 1 + len(run.learner.state.past)
    read = read_answers(file)
    asked = [source for source in run.preferences.rows() if source.side]
    assert read.pairs == tuple(run.preferences.pairs[source.number] for source in asked if not source.tied)
    assert read.shown_first.tolist() == [source.side for source in asked]
    assert list(read.answerers) == [source.answerer for source in asked]


def test_a_table_of_answers_has_the_session_and_the_replays_where_they_are_known(tmp_path):
    file = write_answers(tmp_path / "answers.csv", (PAST[4]._replace(session="monday", replays=3), PAST[3]))
    assert file.read_text().splitlines()[1:] == ["5,1,0,second,Ada,3.0,1,monday,3", "4,6,7,skip,Bob,0.5,,,"]


def test_answers_collected_elsewhere_by_hand(tmp_path):
    file = write_answers(tmp_path / "answers.csv", PAST)
    read = read_answers(file)
    assert read.pairs == ((0, 1), (3, 2), (0, 1), (2, 3), (1, 0))
    assert read.ties == ((4, 5),)
    assert read.shown_first.tolist() == [1, -1, -1, -1, 1, 1]
    assert read.answerers == ("Ada", "Ada", "Ada", "Ada", "Bob", "Bob")
    (tmp_path / "plain.csv").write_text("answer,second,first\nsecond,0,1\nskip,2,1\n")
    assert read_answers(tmp_path / "plain.csv")[:2] == (((0, 1),), ())
    assert read_answers(tmp_path / "plain.csv").answerers is None


def test_the_figures_of_each_person_come_from_a_file_too(tmp_path):
    known = tuple(each._replace(session="monday", replays=each.number) for each in PAST)
    read = read_questions(write_answers(tmp_path / "answers.csv", known))
    assert read == tuple(each._replace(newcomer=each.second) for each in known)
    xr.testing.assert_identical(people(read), people(known))
    (tmp_path / "plain.csv").write_text("first,second,answer,repeats\n0,1,first,\n1,2,tie,\n1,0,second,1\n")
    read = read_questions(tmp_path / "plain.csv")
    assert [(each.number, each.repeats, each.answerer, each.seconds) for each in read] == [
        (1, None, None, None),
        (2, None, None, None),
        (3, 1, None, None),
    ]
    assert people(read)["consistent"].values.tolist() == [1]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1,0,1,first,,", "line 3: question: expected another number in each line, got 1 twice"),
        ("2,0,1,first,7,", "line 3: repeats: expected the number of a question above, got 7"),
        ("2,0,1,first,2,", "line 3: repeats: expected the number of a question above, got 2"),
        ("2,2,3,first,1,", "line 3: repeats: expected a question about the same two, got 1, about others"),
        ("2,0,1,first,,soon", "line 3: seconds: expected a number >= 0, got 'soon'"),
        ("2,0,1,first,,inf", "line 3: seconds: expected a number >= 0, got 'inf'"),
        ("x,0,1,first,,", "line 3: question: expected a whole number >= 0, got 'x'"),
        ("2,0,0,first,,", "line 3: second: expected another number than first, got 0 twice"),
    ],
)
def test_a_bad_cell_of_a_question_is_named(tmp_path, row, message):
    (tmp_path / "answers.csv").write_text(f"question,first,second,answer,repeats,seconds\n1,0,1,tie,,\n{row}\n")
    with pytest.raises(ValueError, match=re.escape(message)):
        read_questions(tmp_path / "answers.csv")


def test_a_line_without_a_number_has_the_next(tmp_path):
    (tmp_path / "answers.csv").write_text("question,first,second,answer\n2,0,1,first\n,1,2,tie\n7,2,3,tie\n,3,4,tie\n")
    assert [past.number for past in read_questions(tmp_path / "answers.csv")] == [2, 3, 7, 8]


def test_a_column_in_capitals_is_not_left_out_without_a_word(tmp_path):
    (tmp_path / "answers.csv").write_text("first,second,answer,Answerer,Age\n0,1,first,Ada,30\n")
    with pytest.raises(ValueError, match=r"answers\.csv: expected the column answerer in small letters, got Answerer"):
        read_answers(tmp_path / "answers.csv")


@pytest.mark.parametrize("mark", ["", "\ufeff"], ids=["plain", "byte-order mark"])
def test_a_byte_order_mark_and_spaces_around_cells_do_no_harm(tmp_path, mark):
    (tmp_path / "excel.csv").write_text(f"{mark}first, second, answer, answerer\n0, 1,first , Ada\n1,2, tie, \n")
    read = read_answers(tmp_path / "excel.csv")
    assert (read.pairs, read.ties, read.answerers) == (((0, 1),), ((1, 2),), ("Ada", ""))


@pytest.mark.slow
def test_a_utility_is_inferred_from_answers_collected_elsewhere(tmp_path):
    read = read_answers(write_answers(tmp_path / "answers.csv", PAST))
    utility = infer_utility(np.random.default_rng(0).normal(size=(6, 2)), **read._asdict())
    assert set(utility.posterior["posterior"]["answerer"].values) == {"Ada", "Bob"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "first,second\n0,1\n",
            "expected the columns first, second, answer, each once and separated by commas, got first, second",
        ),
        ("", "expected the columns first, second, answer, each once and separated by commas, got none"),
        ("first;second;answer\n0;1;first\n", "separated by commas, got first;second;answer"),
        ("first,second,answer,answer\n0,1,first,tie\n", "each once .* got first, second, answer, answer"),
        ("first,second,answer\n0,1,first,Ada\n", "line 2: expected a cell for each column, got 1 more"),
        ("first,second,answer\n0,1,first\n0,x,first\n", "line 3: second: expected a whole number >= 0, got 'x'"),
        ("first,second,answer\n0,1,first\n,1,first\n", "line 3: first: expected a whole number >= 0, got ''"),
        ("first,second,answer\n0,-1,first\n", "line 2: second: expected a whole number >= 0"),
        ("first,second,answer\n0,0,first\n", "line 2: second: expected another number than first, got 0"),
        ("first,second,answer\n0,1,undo\n", "line 2: answer: expected one of first, second, tie, skip, got 'undo'"),
        ("first,second,answer\n0,1,both\n", "line 2: answer: expected one of first, second, tie, skip, got 'both'"),
        ("first,second,answer\n0,1,First\n", "line 2: answer: expected one of .*, got 'First'"),
        ("first,second,answer\n0\n", "line 2: second: expected a whole number >= 0, got ''"),
        ("first,second,answer\n0,1\n", "line 2: answer: expected one of .*, got ''"),
        ("first,second,answer,answerer\n0,1,tie,A\x07\n", "line 2: answerer: expected a printable name"),
    ],
)
def test_a_bad_table_of_answers_is_refused_by_its_line(tmp_path, text, expected):
    (tmp_path / "answers.csv").write_text(text)
    with pytest.raises(ValueError, match=expected) as refused:
        read_answers(tmp_path / "answers.csv")
    assert str(refused.value).startswith(str(tmp_path / "answers.csv"))
    with pytest.raises(ValueError, match=r"missing\.csv: "):
        read_answers(tmp_path / "missing.csv")


def test_the_margin_of_a_report_is_of_the_utility_without_the_side():
    """The same pair, answered by the side: what the answerer adds for it is no utility."""
    rows = np.array([[0.5, 0.1], [0.5, 0.1], [-0.5, -0.1], [-0.5, -0.1]])
    sampled = {"likelihood": "logistic", "num_samples": 100, "max_samples": 100, "seed": 0}
    for answerers in (None, ["Ada", "Bob", "Ada", "Bob"]):
        tree = sample_posterior(rows, shown_first=[1, 1, 1, 1], answerers=answerers, **sampled)
        margins, utility = tree["posterior/margins"].values, utility_margins(tree)
        weights = tree["posterior/utility_weights"].values
        np.testing.assert_allclose(utility, weights @ rows.T, atol=1e-9)
        assert margins.mean() > utility.mean() + 0.05
