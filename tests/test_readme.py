import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=[f"example-{number}" for number in range(1, len(EXAMPLES) + 1)])
def test_every_example_of_the_readme_runs_as_printed(example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(example, "README.md", "exec"), names)
    assert capsys.readouterr().out
    if "Cart" in names:  # which learns where its expert wants it
        missed = [np.abs(trajectory.states[:, 0] - 1).mean() for trajectory in names["learner"].trajectories]
        assert np.mean(missed[-10:]) < 0.3 * np.mean(missed[:10])


def test_the_first_example_takes_ten_lines():
    assert 1 <= len([line for line in EXAMPLES[0].splitlines() if line.strip()]) <= 10


def test_the_map_of_the_house_names_every_module_and_nothing_else():
    drawn = re.search(r"```\nbayespbrl/(.*?)```", README, flags=re.DOTALL).group(1)
    named = set(re.findall(r"\b(\w+)\.py\b", drawn))
    there = {file.stem for file in (ROOT / "bayespbrl").glob("*.py") if not file.stem.startswith("__")}
    assert named == there
    for folder in (ROOT / "bayespbrl").iterdir():
        if folder.is_dir() and not folder.name.startswith("__"):
            assert f"  {folder.name}/" in drawn


def anchors(page):
    """The names by which links reach the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_every_link_to_a_file_leads_somewhere(page):
    links = [link for link in re.findall(r"\]\(([^)]+)\)", page.read_text()) if "://" not in link]
    assert links
    for link in links:
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_every_reference_is_cited_by_author_and_year_where_the_page_says():
    entries = [line for line in (ROOT / "docs" / "references.md").read_text().splitlines() if line.startswith("* ")]
    assert len(entries) > 50
    for entry in entries:
        work, _, citing = entry.partition("Cited in")
        author, year = re.match(r"\* ([^,]+),", work)[1], re.search(r"\((\d{4})", work)[1]
        files = re.findall(r"\]\(\.\./([^)]+)\)", citing)
        assert files, entry
        for file in files:
            text = (ROOT / file).read_text()
            assert author in text, f"{author} in {file}"
            assert year in text, f"{author} {year} in {file}"
