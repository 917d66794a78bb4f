"""What `SECURITY.md` promises of files from others, and that its tests are there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from dreamer_racing.evaluation.dreams import Dream
from dreamer_racing.hil.configuration import HilConfig
from dreamer_racing.plant.process import ProcessOptions
from tests.running_recipes import recipe_module
from tests.training.test_checkpoint import Payload

ROOT = Path(__file__).parents[1]
RUNS_TEXT = {"eval", "exec", "compile", "__import__"}
UNPICKLES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
OWN_MEMORY = {"dreamer_racing/hil/view.py": ["marshal"]}  # from a flight to its own child, by a pipe
SOURCES = [*(ROOT / "dreamer_racing").rglob("*.py"), *(ROOT / "recipes").rglob("*.py")]


def suspicious(tree: ast.AST) -> list[str]:
    """Calls and imports that run or unpickle what they read."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.split(".")[0] in UNPICKLES]
        elif isinstance(node, ast.ImportFrom):
            found += [node.module] if (node.module or "").split(".")[0] in UNPICKLES else []
        elif isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            options = {word.arg: ast.unparse(word.value) for word in node.keywords}
            bad = (
                name in RUNS_TEXT,
                name == "torch.load" and options.get("weights_only") != "True",
                "allow_pickle" in options and options["allow_pickle"] != "False",
                name == "yaml.load" and options.get("Loader") != "_PlainLoader",  # a SafeLoader
                name in ("yaml.unsafe_load", "yaml.full_load", "yaml.load_all"),
            )
            found += [ast.unparse(node)] if any(bad) else []
    return found


def test_nothing_unpickles_or_evaluates():
    found = {str(path.relative_to(ROOT)): suspicious(ast.parse(path.read_text(encoding="utf-8"))) for path in SOURCES}
    assert {path: calls for path, calls in found.items() if calls} == OWN_MEMORY
    from dreamer_racing.envs.tracks.loading import _PlainLoader

    assert issubclass(_PlainLoader, yaml.SafeLoader)


@pytest.mark.parametrize(
    "text",
    ["import pickle", "torch.load(f)", "np.load(f, allow_pickle=True)", "eval(x)", "yaml.load(f, Loader=Loader)"],
)
def test_what_is_searched_for_is_found(text):
    assert suspicious(ast.parse(text))


def test_a_pickle_in_an_array_is_refused_and_nothing_of_it_is_run(tmp_path):
    witness, file = tmp_path / "witness", tmp_path / "000000001_dream.npz"
    np.savez(file, real=np.array([Payload(witness)], dtype=object))
    with pytest.raises(ValueError, match="holds no dream"):
        Dream.load(file)
    assert not witness.exists()
    with np.load(file, allow_pickle=True) as content:
        content["real"]
    assert witness.exists(), "the array was harmless: this test has tested nothing"


@pytest.mark.parametrize("value", ["${oc.env:HOME}", "[1, '${oc.env:HOME}']", "!!python/object/apply:os.getcwd []"])
def test_a_configuration_that_refers_elsewhere_is_refused(tmp_path, value):
    text = (ROOT / "agents" / "circle" / "config.yaml").read_text(encoding="utf-8")
    (tmp_path / "config.yaml").write_text(re.sub(r"(?m)^track: .*$", f"track: {value}", text))
    with pytest.raises(ValueError, match=r"config\.yaml") as refused:
        recipe_module("composing.saved").trained_config(tmp_path)
    assert str(Path.home()) not in str(refused.value).replace(str(tmp_path), "")


def test_what_listens_does_so_on_this_machine_alone():
    hosts = [HilConfig().pose_host, HilConfig().operator_host, HilConfig().link_host, ProcessOptions().host]
    assert hosts == ["127.0.0.1"] * 4


def test_every_test_that_the_page_names_is_there():
    page = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    named = set(re.findall(r"`(test_\w+)`", page))
    assert len(named) >= 10 and {name for name in named if f"def {name}(" not in tests} == set()
    assert {path for path in re.findall(r"`(tests/[\w/.]+)`", page) if not (ROOT / path).exists()} == set()
