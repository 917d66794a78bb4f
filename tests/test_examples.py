"""The examples, run as a user runs them, and the page that shows them."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.running_recipes import module_of

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "examples" / "first_flight.ipynb"
EXAMPLES = {path.stem: path for path in (ROOT / "examples").glob("*.py")}
PAGE = (ROOT / "docs" / "library.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    """What runs the examples to their ends, and reads them."""
    return module_of("benchmarks", "front_doors")


def run(name: str, *arguments: str, cwd: Path) -> str:
    """What an example prints; it must succeed and write nothing where it runs."""
    command = [sys.executable, str(EXAMPLES[name]), *arguments]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), os.environ.get("PYTHONPATH", "")))}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False)
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
def test_ppo_of_others(
    tmp_path: Path, name: str, arguments: tuple[str, ...], steps: int, benchmark: ModuleType
) -> None:
    if name == "sb3":
        pytest.importorskip("stable_baselines3", reason="needs the extra `sb3`: pip install -e '.[sb3]'")
    *curve, sampled, mean = run(name, *arguments, cwd=tmp_path).splitlines()
    rows = [row for row in map(benchmark.PROGRESS.fullmatch, curve) if row]
    assert int(rows[-1][1]) == steps and -30.0 < float(rows[-1][2]) < 30.0 and float(rows[-1][3]) < 3.0
    races = {actions: benchmark.RACES.fullmatch(line) for actions, line in (("sampled", sampled), ("mean", mean))}
    for actions, race in races.items():
        assert race and race.groups() == (actions, "0", "100", "nan"), "nobody has learnt yet"


def test_curves_are_read_off_what_examples_print(benchmark: ModuleType, tmp_path: Path, monkeypatch) -> None:
    said = ["128 steps: return -3.5, 0.1 gates an episode", "256 steps: return 210.0, 17.5 gates an episode"]
    said.append("sampled actions: three laps from 93 of 100 noisy starts, 2.61 s a lap")
    said.append("mean actions: three laps from 0 of 100 noisy starts, nan s a lap")
    (tmp_path / "examples").mkdir()
    (tmp_path / "examples" / "ppo.py").write_text("".join(f"print({line!r})\n" for line in said))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["front_doors.py", "--folder", "out", "--examples", "ppo", "--env-steps", "200"])
    benchmark.main()
    (record,) = json.loads((tmp_path / "out" / "ppo.json").read_text())
    assert record["command"] == "python examples/ppo.py --env-steps 200"
    assert (record["env_steps"], record["finished"], record["starts"], record["lap_s"]) == (256, 93, 100, 2.61)
    assert (record["mean_finished"], record["mean_starts"], record["mean_lap_s"]) == (0, 100, None)
    rows = [line.split(",") for line in (tmp_path / "out" / "ppo.csv").read_text().splitlines()]
    assert rows[0] == list(benchmark.CURVE) and [rows[2][0], *rows[2][2:]] == ["256", "210.0", "17.5"]
    assert (tmp_path / "out" / "curves.png").stat().st_size > 5_000
    (tmp_path / "examples" / "ppo.py").write_text("raise SystemExit(3)")
    with pytest.raises(SystemExit, match="examples/ppo.py --env-steps 200: exit status 3"):
        benchmark.main()


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
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", "MPLCONFIGDIR": str(tmp_path)}
    command = [sys.executable, "-W", "ignore:FigureCanvasAgg is non-interactive", "-c", "\n".join(cells("code"))]
    folder = NOTEBOOK.parent
    before = sorted(folder.iterdir())
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
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
