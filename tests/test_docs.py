"""What the documentation says can be done: its Python blocks run, its commands parse, its links lead somewhere."""

import re
import shlex
from pathlib import Path

import pytest

from sb3_flock.cli import _parse

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
README = (ROOT / "README.md").read_text()


def heading_anchors(page):
    """The anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), target
        assert ROOT in there.parents, target
        if anchor and there.suffix == ".md":
            assert anchor in heading_anchors(there), target


def test_the_readme_fits_on_a_few_screens():
    assert len(README.splitlines()) <= 150


def test_the_readmes_python_runs(tmp_path, monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    assert len(blocks) == 2
    short = {"50_000": "300", "episodes=100": "episodes=2", "n_obstacles=2)": "n_obstacles=2, max_cycles=3)"}
    for block in blocks:
        assert len(block.splitlines()) <= 10
        for long, quick in short.items():
            block = block.replace(long, quick)  # noqa: PLW2901
        exec(compile(block, "README.md", "exec"), {})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_commands_parse(page):
    for block in re.findall(r"```sh\n(.*?)```", page.read_text(), flags=re.S):
        for line in block.replace("\\\n", " ").splitlines():
            for command in re.findall(r"sb3-flock ([^&|;]*)", line.split("#")[0]):
                words = shlex.split(command)
                if "*" not in command and "<" not in command and words:
                    _parse(words)
