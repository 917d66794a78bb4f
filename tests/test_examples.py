"""The examples, run as a user runs them, and the page that shows them."""

import json
import re
from pathlib import Path

import pytest

from tests.forked import program
from tests.running_recipes import ROOT, python

NOTEBOOK = ROOT / "examples" / "first_flight.ipynb"
EXAMPLES = {path.stem: path for path in (ROOT / "examples").glob("*.py")}
PAGE = (ROOT / "docs" / "library.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


PROGRESS = re.compile(r"(\d+) steps: return (-?[\d.]+), ([\d.]+) gates an episode")
RACES = re.compile(r"(sampled|clipped mean) actions: three laps from (\d+) of (\d+) noisy starts, (nan|[\d.]+) s a lap")


def run(name: str, *arguments: str, cwd: Path) -> str:
    """What an example prints; it must succeed and write nothing where it runs."""
    done = program(EXAMPLES[name], *arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr, done.stderr
    assert not list(cwd.iterdir())
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arguments", "steps"),
    [
        ("td3", ("--rollouts", "6", "--random-rollouts", "4"), 3072),  # two rollouts with updates
        ("a2c", ("--rollouts", "3"), 3072),
    ],
)
def test_torchrl_loops(tmp_path: Path, name: str, arguments: tuple[str, ...], steps: int) -> None:
    line = run(name, *arguments, cwd=tmp_path).splitlines()[-1]  # TorchRL logs there too
    match = re.fullmatch(rf"{steps} steps: return (-?\d+\.\d), (\d+\.\d) gates an episode", line)
    assert match, line
    # Whoever has not learnt yet crashes: -4, and in some metres of progress at most a few gates.
    assert -30.0 < float(match[1]) < 30.0 and float(match[2]) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arguments", "steps"),
    [
        ("cleanrl", ("--num-envs", "64", "--env-steps", "4000"), 4096),  # two rollouts
        ("ppo", ("--env-steps", "16384"), 16384),
        ("sb3", ("--num-envs", "64", "--env-steps", "8192"), 8192),
    ],
)
def test_ppo_of_others(tmp_path: Path, name: str, arguments: tuple[str, ...], steps: int) -> None:
    if name == "sb3":
        pytest.importorskip("stable_baselines3", reason="needs the extra `sb3`: pip install -e '.[sb3]'")
    *curve, sampled, clipped_mean = run(name, *arguments, cwd=tmp_path).splitlines()
    rows = [row for row in map(PROGRESS.fullmatch, curve) if row]
    assert int(rows[-1][1]) == steps and -30.0 < float(rows[-1][2]) < 30.0 and float(rows[-1][3]) < 3.0
    for actions, line in (("sampled", sampled), ("clipped mean", clipped_mean)):
        race = RACES.fullmatch(line)
        assert race and race.groups() == (actions, "0", "100", "nan"), "nobody has learnt yet"


@pytest.mark.slow
def test_dm_control_loop(tmp_path: Path) -> None:
    lines = run("dm_control_wrapper", "--env-steps", "1000", cwd=tmp_path).splitlines()
    assert lines[0].endswith("steps, crashed: True")
    assert "'target_gate'" in lines[1] and "'terminated'" in lines[1]
    assert [bool(re.match(r"\d+ episodes, returns \[", line)) for line in lines[2:]] == [True, True]


def test_the_page_shows_the_files() -> None:
    sources = {name: path.read_text() for name, path in EXAMPLES.items()}
    shown = [[name for name, source in sources.items() if block in source] for block in BLOCKS]
    strays = [block for block, names in zip(BLOCKS, shown, strict=True) if not names]
    assert not strays, f"docs/library.md shows code that no file of examples/ has:\n{strays[0]}"
    assert {name for names in shown for name in names} == set(EXAMPLES)
    for name in EXAMPLES:
        assert f"python examples/{name}.py" in PAGE


@pytest.mark.parametrize("name", ["td3", "a2c"])
def test_torchrl_loops_are_short(name: str) -> None:
    assert len(EXAMPLES[name].read_text().splitlines()) < 60


def cells(kind: str) -> list[str]:
    """The notebook's cells of a kind."""
    found = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == kind]


@pytest.mark.slow
def test_the_notebook_flies_and_knows_where_gates_are(tmp_path: Path) -> None:
    command = ["-W", "ignore:FigureCanvasAgg is non-interactive", "-c", "\n".join(cells("code"))]
    folder = NOTEBOOK.parent
    before = sorted(folder.iterdir())
    done = python(*command, cwd=folder, MPLBACKEND="Agg", MPLCONFIGDIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert sorted(folder.iterdir()) == before
    assert done.stdout.count("finished           1 (100%)") == 2, "pilot and agent fly three laps"
    explained = [float(number) for number in re.findall(r"explained (-?\d\.\d\d)$", done.stdout, re.MULTILINE)]
    assert len(explained) == 7 and min(explained) > 0.8


def test_the_notebook_is_kept_without_outputs_and_its_links_lead_somewhere() -> None:
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        assert not cell.get("outputs") and cell.get("execution_count") is None
    links = re.findall(r"\]\(([^)]+)\)", "\n".join(cells("markdown")))
    assert links and all((NOTEBOOK.parent / link).is_file() for link in links)
