"""Built-in tracks, the form of a track file, every refusal, and tracks made from tracks."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from dreamer_racing.envs import tracks
from dreamer_racing.envs.tracks import (
    BUILTIN_TRACKS,
    PLAIN_TRACKS,
    Gate,
    GateShape,
    Track,
    TrackError,
    decoys_for,
    describe_track,
    displace_gates,
    hash_track,
    load_track,
    make_track,
    read_track,
    validate_track,
    with_decoys,
)
from dreamer_racing.envs.tracks.validation import boxes_intersect
from tests.running_recipes import ROOT

PAGE = (ROOT / "docs" / "simulation.md").read_text(encoding="utf-8").partition("\n## Physics")[0]

GOOD = """\
name: mine
laps: 2
gates:
  - {position: [0, 0, 1.35], yaw_degrees: 0}
  - {position: [6, 0, 1.35], yaw_degrees: 0, kind: race, color: [1, 0.5, 0]}
  - {position: [6, 6, 1.35], yaw_degrees: 180}
decoys:
  - {position: [0, 6, 1.35], yaw_degrees: 45}
shape: {opening: 1.4, margin: 0.2}
start: {position: [-2, 0.5, 1], yaw_degrees: 10}
bounds: {low: [-5, -5, 0], high: [10, 10, 5]}
"""


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a track file and returns its path."""

    def write_file(text: str) -> Path:
        path = tmp_path / "mine.yaml"
        path.write_text(text, encoding="utf-8", errors="surrogateescape")
        return path

    return write_file


# ---------------------------------------------------------------- built-in tracks


def test_every_file_is_a_builtin_track():
    assert {path.stem for path in Path(tracks.__file__).parent.glob("*.yaml")} == set(BUILTIN_TRACKS)


def test_the_page_names_every_builtin_track_with_its_gates():
    rows = re.findall(r"^\| `(\w+)` \| (\d+)", PAGE, re.M)
    loaded = {name: load_track(name) for name in BUILTIN_TRACKS}
    assert {name: int(gates) for name, gates in rows} == {name: track.num_gates for name, track in loaded.items()}
    assert all(track.name == name and load_track(track) is track for name, track in loaded.items())


def test_the_example_of_the_page_gives_every_default(write):
    """But for its decoys and a colour."""
    (example,) = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.M | re.S)
    given = yaml.safe_load(example)
    assert {"start", "bounds", "shape"} < given.keys()
    track = load_track(write(example))
    plain = load_track(write(yaml.safe_dump({"gates": given["gates"]})))
    assert plain.name == "mine"  # of its file, mine.yaml
    for name in ("start_position", "start_yaw_degrees", "bounds_low", "bounds_high"):
        assert getattr(plain, name) == pytest.approx(getattr(track, name))
    assert (plain.gates, plain.shape, plain.laps) == (track.gates, track.shape, track.laps)
    assert track.decoys[0].color and set(given["shape"]) == {field.name for field in dataclasses.fields(GateShape)}


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_yaws_agree_with_the_order_of_flight(name):
    """But for split_s's second gate, which is left at a right angle (0.15 m back over 10 m)."""
    gates = load_track(name).gates
    for index, gate in enumerate(gates):
        for other, sign in ((gates[index - 1], 1), (gates[(index + 1) % len(gates)], -1)):
            along = sign * sum((a - b) * n for a, b, n in zip(gate.position, other.position, gate.forward, strict=True))
            assert along > -0.2, (name, index)


def test_circle_is_a_circle():
    for index, gate in enumerate(load_track("circle").gates):
        angle = math.radians(90 * index)
        assert gate.position == pytest.approx((4 * math.cos(angle), 4 * math.sin(angle), 1.35))
        assert gate.forward == pytest.approx((-math.sin(angle), math.cos(angle), 0.0))


def test_split_s_is_the_published_track():
    track = load_track("split_s")
    assert track.gates[3].position == (-4.3, -5.6, 3.4)
    assert track.gates[4].position == (-4.3, -5.6, 1.42)
    assert [gate.yaw_degrees for gate in track.gates] == [-20, 0, -130, 180, 0, 80, -150]
    assert track.start_position == (-5.0, 4.7, 0.61)
    assert track.start_yaw_degrees == pytest.approx(math.degrees(math.atan2(-5.56, 4.4)))  # to the first gate
    assert (track.bounds_low, track.bounds_high) == ((-10, -8, 0.05), (14, 9, 6))


# ---------------------------------------------------------------- files


def test_a_good_file(write):
    path = write(GOOD)
    for argument in (path, str(path)):
        assert load_track(argument) == Track(
            name="mine",
            gates=(Gate((0, 0, 1.35), 0), Gate((6, 0, 1.35), 0, color=(1, 0.5, 0)), Gate((6, 6, 1.35), 180)),
            decoys=(Gate((0, 6, 1.35), 45, kind="decoy"),),
            shape=GateShape(opening=1.4, margin=0.2),
            start_position=(-2, 0.5, 1),
            start_yaw_degrees=10,
            bounds_low=(-5, -5, 0),
            bounds_high=(10, 10, 5),
            laps=2,
        )


# Each case: what to replace in GOOD, by what, and the pieces that the message must have.
REFUSALS = {
    "unknown field": ("laps: 2", "lapps: 2", ["lapps", "2", "did you mean laps"]),
    "unknown field of a gate": ("kind: race", "colour: red", ["gates[1].colour", "red", "did you mean color"]),
    "missing gates": ("gates:", "gatez:", ["gatez", "did you mean gates"]),
    "missing yaw": ("yaw_degrees: 180", "", ["gates[2].yaw_degrees", "missing", "position"]),
    "missing high": (", high: [10, 10, 5]", "", ["bounds.high", "missing"]),
    "wrong kind": ("kind: race", "kind: rase", ["gates[1].kind", "'rase'", "'race'"]),
    "decoy among gates": ("kind: race", "kind: decoy", ["gates[1].kind", "'decoy'", "decoys in decoys"]),
    "text for a number": ("yaw_degrees: 180", "yaw_degrees: north", ["gates[2].yaw_degrees", "'north'", "finite"]),
    "not finite": ("[6, 6, 1.35]", "[6, .nan, 1.35]", ["gates[2].position", "nan", "finite"]),
    "huge integer": ("[6, 6, 1.35]", f"[6, 1{'0' * 400}, 1.35]", ["gates[2].position", "finite"]),
    "two coordinates": ("[6, 6, 1.35]", "[6, 6]", ["gates[2].position", "(6.0, 6.0)", "three finite numbers"]),
    "nothing for a vector": ("[6, 6, 1.35]", "null", ["gates[2].position is missing"]),
    "a mapping for a vector": ("[6, 6, 1.35]", "{x: 6}", ["gates[2].position", "{'x': 6}", "three finite numbers"]),
    "gate is a list": ("{position: [6, 6, 1.35], yaw_degrees: 180}", "[6, 6]", ["gates[2]", "[6, 6]", "mapping"]),
    "decoys is a mapping": ("  - {position: [0, 6", "    {position: [0, 6", ["decoys", "a list of gates"]),
    "color out of range": ("[1, 0.5, 0]", "[255, 0.5, 0]", ["gates[1].color", "255", "from 0 to 1"]),
    "laps of zero": ("laps: 2", "laps: 0", ["laps", "0", "at least 1"]),
    "empty name": ("name: mine", "name: ''", ["name", "''", "not empty"]),
    "opening too large": ("opening: 1.4", "opening: 2.1", ["shape.outer", "2.05", "2.1"]),
    "opening of zero": ("opening: 1.4", "opening: 0", ["shape.opening", "0.0", "greater than 0"]),
    "flat gate": ("opening: 1.4", "depth: 0", ["shape.depth", "0.0", "greater than 0"]),
    "margin too large": ("margin: 0.2", "margin: 0.7", ["shape.margin", "0.7", "half of shape.opening"]),
    "bounds inverted": ("high: [10, 10, 5]", "high: [10, -10, 5]", ["bounds.high[1]", "-10.0", "-5.0", "y axis"]),
    "gate outside": ("[6, 6, 1.35]", "[6, 9.8, 1.35]", ["gates[2].position", "9.8", "inside the bounding box", "10.3"]),
    "gate under ground": ("[6, 6, 1.35]", "[6, 6, 0.5]", ["gates[2].position", "0.5", "above 0.05 m"]),
    "gate above the box": ("[6, 6, 1.35]", "[6, 6, 4.6]", ["gates[2].position", "4.6", "inside the bounding box"]),
    "no way to the gate": ("[6, 6, 1.35]", "[9.2, 6, 1.35]", ["gates[2].position", "9.2", "1.0 m before it", "10.2"]),
    "decoy outside": ("[0, 6, 1.35]", "[0, 60, 1.35]", ["decoys[0].position", "60", "bounding box"]),
    "gates overlap": ("[6, 6, 1.35]", "[6, 1, 1.35]", ["gates[1].position", "gates[2]", "opening", "farther from"]),
    "decoy in a gate": ("[0, 6, 1.35]", "[6, 6, 1.35]", ["gates[2].position", "decoys[0]", "opening"]),
    "start outside": ("[-2, 0.5, 1]", "[-20, 0.5, 1]", ["start.position", "-20", "bounding box"]),
    "start on the ground": ("[-2, 0.5, 1]", "[-2, 0.5, 0.1]", ["start.position", "0.1", "above 0.05 m"]),
    "start behind": ("[-2, 0.5, 1]", "[2, 0.5, 1]", ["start.position", "gates[0]", "2.00 m behind"]),
    "start too near": ("[-2, 0.5, 1]", "[-0.6, 0.5, 1]", ["start.position", "gates[0]", "0.60 m before"]),
    "start in another gate": ("[6, 6, 1.35]", "[-2, -0.5, 1.35]", ["start.position", "gates[2]"]),
    "gate at the end of the world": ("[6, 6, 1.35]", "[6, 1.0e+300, 1.35]", ["gates[2].position", "within 1000 m"]),
    "opening of nothing": ("opening: 1.4", "opening: 1.0e-9", ["shape.opening", "1e-09", "0.01 m at least"]),
    "a billion laps": ("laps: 2", "laps: 1000000000", ["laps", "1000000000", "at most 1,000"]),
    "laps without end": ("laps: 2", f"laps: 0x{'f' * 5000}", ["laps", "thousands of digits", "at most 1,000"]),
    "a long text": ("name: mine", f"name: [{'x' * 5000}]", ["name", "['xxx", "…", "a text that is not empty"]),
    "a long key": ("name: mine", f"{'x' * 900}: 1", ["xxx…", "unknown field"]),
    "start is a list": ("start: {position: [-2, 0.5, 1], yaw_degrees: 10}", "start: [1]", ["start", "[1]", "mapping"]),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals_name_file_field_and_value(write, case):
    old, new, pieces = REFUSALS[case]
    assert GOOD.count(old) == 1
    path = write(GOOD.replace(old, new))
    with pytest.raises(TrackError) as refusal:
        load_track(path)
    message = str(refusal.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    for piece in pieces:
        assert piece in message


@pytest.mark.parametrize(
    ("field", "gate", "start", "laps"),
    [("gates[1].position", 600, -3, 1), ("start.position", 900, -900, 1), ("gates[0].position", 450, -3, 2)],
    ids=["a gate", "the start", "the next lap"],
)
def test_a_leg_beyond_the_range_of_a_flight_is_refused(write, field, gate, start, laps):
    """The second gate at x=gate; where there is a next lap, a third as far to the left of it."""
    far = [[0, 0, 1.35], [gate, 0, 1.35], [gate, gate, 1.35]] if laps > 1 else [[0, 0, 1.35], [gate, 0, 1.35]]
    gates = "".join(f"  - {{position: {position}, yaw_degrees: 0}}\n" for position in far)
    box = "bounds: {low: [-1000, -1000, 0], high: [1000, 1000, 6]}"
    text = f"gates:\n{gates}start: {{position: [{start}, 0, 1.35]}}\nlaps: {laps}\n{box}\n"
    with pytest.raises(TrackError, match=r"at most 540 m from .*, the range of one flight: it is \d+ m") as refusal:
        load_track(write(text))
    assert field in str(refusal.value)
    near = text.replace(str(gate), "200").replace(f"[{start},", "[-3,")
    assert load_track(write(near)).laps == laps


MANY = "".join(f"  - {{position: [{4 * row}, {4 * column}, 1.35], yaw_degrees: 0}}\n"
               for row in range(15) for column in range(14))  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gates: [\nname: x", "not valid YAML at line 2"),
        ("name: a\nname: b\n", "line 2.*'name' is given twice"),
        ("name: !!python/object/apply:os.getcwd []", "not valid YAML at line 1"),
        ("name: 2020-99-99", "not valid YAML"),
        ("", "the track file is empty; it must have gates"),
        ("# nothing yet", "the track file is empty; it must have gates"),
        ("- 1", r"the file is \[1\].*a mapping"),
        ("{}", "gates is missing"),
        ("name: &a [x]\nlaps: *a", "line 2.*aliases"),
        ("a: &a {x: 1}\nb: {<<: *a}", "line 2.*aliases"),
        (f"# {'x' * 200_000}\ngates: []", "200,0.. bytes, but must have no more than 100,000"),
        ("\udcff\udcfe", r"mine\.yaml: the track file cannot be read"),  # no UTF-8
        ("gates: []\n", r"gates is \[.*at least 2 race gates"),
        ("gates: [{position: [0, 0, 1.35], yaw_degrees: 0}]\n", r"gates is \[.*at least 2 race gates"),
        (f"gates:\n{MANY}", "gates and decoys are 210 together, but must be 200 at most"),
    ],
)
def test_files_that_are_no_track_are_refused(write, text, message):
    path = write(text)
    with pytest.raises(TrackError, match=message) as refusal:
        load_track(path)
    assert str(path) in str(refusal.value)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        *((value, "a track is a name, the path of a .yaml file or a Track, not ")
          for value in (None, 3, 1.5, ["kidney"], b"kidney")),
        ("x" * 5000 + ".yaml", "the track file "),
        ("a\0b.yaml", "the track file "),
        ("kidny", r"'kidny' \(did you mean kidney\?\).*circle, kidney.*path of a \.yaml file"),
        ("xyz", "unknown track 'xyz': the known tracks"),
        ("nowhere/kidney.yaml", r"'nowhere/kidney\.yaml' does not exist.*known tracks: circle"),
        (Path(__file__).parent, "is not a file"),
    ],
)  # fmt: skip
def test_what_is_neither_a_name_nor_a_file_is_refused(argument, message):
    with pytest.raises(TrackError, match=message) as refusal:
        load_track(argument)
    assert len(str(refusal.value)) < 500


# ---------------------------------------------------------------- tracks built in Python


CIRCLE = load_track("circle")
FIRST, *OTHERS = CIRCLE.gates


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": (4.0, None, 1.35)}, r"gates[0].position is (4.0, None, 1.35), but must be three finite numbers"),
        ({"position": (4.0, True, 1.35)}, "gates[0].position is (4.0, True, 1.35), but must be three finite numbers"),
        ({"position": 4.0}, "gates[0].position is 4.0, but must be three finite numbers"),
        ({"position": "abc"}, "gates[0].position is 'abc', but must be three finite numbers"),
        ({"position": (4.0, 10**400, 1.35)}, "gates[0].position is (4.0, 1000"),
        ({"yaw_degrees": "0"}, "gates[0].yaw_degrees is '0', but must be a finite number"),
        ({"color": (1.0, 1.5, 0.0)}, "gates[0].color is (1.0, 1.5, 0.0), but must be three numbers [red, green, blue]"),
        ({"color": (1.0, 0.0)}, "gates[0].color is (1.0, 0.0), but must be three numbers"),
        ({"color": "red"}, "gates[0].color is 'red', but must be three numbers"),
    ],
)
def test_gates_built_in_python_are_refused_by_name_and_field(change, message):
    gates = (dataclasses.replace(FIRST, **change), *OTHERS)
    for build in (lambda: dataclasses.replace(CIRCLE, gates=gates), lambda: make_track("circle", gates)):
        with pytest.raises(TrackError, match="^" + re.escape(f"Track('circle'): {message}")):
            load_track(build())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gates": (*CIRCLE.gates, (0.0, 0.0, 1.0))}, "gates[4] is (0.0, 0.0, 1.0), but must be a Gate"),
        ({"gates": None}, "gates is None, but must be a sequence of gates"),
        ({"decoys": 3}, "decoys is 3, but must be a sequence of gates"),
        ({"shape": None}, "shape is None, but must be a GateShape"),
        ({"shape": GateShape(depth="0.1")}, "shape.depth is '0.1', but must be a finite number"),
        ({"start_position": (0.0, None, 1.0)}, "start.position is (0.0, None, 1.0), but must be three finite numbers"),
        ({"start_yaw_degrees": math.inf}, "start.yaw_degrees is inf, but must be a finite number"),
        ({"bounds_high": None}, "bounds.high is None, but must be three finite numbers"),
        ({"laps": 1.5}, "laps is 1.5, but must be a whole number"),
        ({"laps": True}, "laps is True, but must be a whole number"),
        ({"laps": 0}, "laps is 0, but must be a whole number of at least 1"),
        ({"gates": CIRCLE.gates[:1]}, "gates is (Gate("),
        ({"decoys": CIRCLE.gates[:1]}, "decoys[0].kind is 'race'"),
        ({"name": " "}, "name is ' ', but must be a text that is not empty"),
    ],
)
def test_fields_of_tracks_built_in_python_are_refused_by_name(change, message):
    track = dataclasses.replace(CIRCLE, **change)
    with pytest.raises(TrackError, match="^" + re.escape(f"Track({track.name!r}): {message}")):
        load_track(track)


def test_defaults_do_not_follow_from_a_start_that_is_none():
    with pytest.raises(TrackError, match=re.escape("Track('mine'): start.position is (0.0, None, 1.0)")):
        make_track("mine", CIRCLE.gates, start_position=[0.0, None, 1.0])


@pytest.mark.parametrize("array", [list, np.array, lambda numbers: np.array(numbers, np.float32), torch.tensor])
def test_numbers_of_any_kind_make_the_track_that_floats_make(array):
    """Of 1/4 and 3/8, which float32 holds exactly: what comes is hashed, described and compared as if of a file."""

    def build(vector, number, laps):
        gates = [Gate(vector([0.25, 0.0, 2.375]), number(90.0), color=vector([1.0, 0.5, 0.25])),
                 Gate(vector([0.25, 6.0, 2.375]), number(90.0))]  # fmt: skip
        shape = GateShape(opening=number(1.25), margin=number(0.125))
        corners = {"bounds_low": vector([-9.0, -9.0, 0.0]), "bounds_high": vector([9.0, 15.0, 6.0])}
        start = vector([0.25, -2.5, 1.25])
        return make_track("mine", gates, shape=shape, start_position=start, laps=laps, **corners)

    plain = load_track(build(tuple, float, 2))
    made = load_track(build(array, np.float32, np.int64(2)))
    assert made == plain and hash(made) == hash(plain)
    assert hash_track(made) == hash_track(plain)
    assert read_track(describe_track(made), "a copy") == plain
    listed = dataclasses.replace(plain, gates=list(plain.gates), bounds_low=[-9, -9, 0])
    assert load_track(listed) == plain and hash(listed) == hash(plain)


@pytest.mark.parametrize(
    ("name", "beginning"),
    [
        ("circle", "9374b4c41ac86e07"),
        ("kidney", "c9bea353eed64395"),
        ("figure8", "cd9fba7cd82eb68d"),
        ("split_s", "0cbed177605e9003"),
        ("figure8_decoys", "38b3801af1f5704e"),
    ],
)
def test_hashes_of_builtin_tracks_stay(name, beginning):
    """Contracts of agents that ship hold them."""
    assert hash_track(load_track(name)).startswith(beginning)


# ---------------------------------------------------------------- overlaps


def pair(distance, turn: float = 0.0) -> Track:
    """Two gates in a large hall, the second one moved and turned."""
    gates = [Gate((0.0, 0.0, 3.0), 0.0), Gate(tuple(a + b for a, b in zip(distance, (0, 0, 3), strict=True)), turn)]
    return make_track(
        "pair", gates, start_position=(-8.0, 0.0, 3.0), bounds_low=(-15.0, -15.0, 0.0), bounds_high=(15.0, 15.0, 9.0)
    )


# The opening reaches 0.75 m and the frame 1.025 m from a gate's centre: they meet at 1.775 m.
@pytest.mark.parametrize(
    ("distance", "turn", "overlaps"),
    [
        ((0, 0, 1.98), 180, False),  # split_s: frames share 7 cm, openings are free
        ((0, 0, 1.78), 180, False),
        ((0, 0, 1.77), 180, True),
        ((0, 1.78, 0), 0, False),
        ((0, 1.77, 0), 0, True),
        ((0.11, 0, 0), 0, False),  # one behind the other, 0.1 m deep each
        ((0.09, 0, 0), 0, True),
        ((0, 0, 0), 90, True),  # crossed through the centre
        ((0, 0.9, 0), 90, True),  # the first gate's bar stands in the middle of the second's opening
        ((0, 1.78, 0), 90, False),
        ((1.08, 0, 0), 90, False),  # a T: the second frame's end stops 1.08 - 1.025 > 0.05 m before the first plane
        ((1.07, 0, 0), 90, True),
        ((1.3, 1.3, 0), 45, False),  # the frames' circles about their centres meet, the gates do not
    ],
)
def test_overlaps(distance, turn, overlaps):
    if overlaps:
        with pytest.raises(TrackError, match=r"gates\[[01]\]\.position .* reaches into the opening"):
            validate_track(pair(distance, turn), "test")
    else:
        validate_track(pair(distance, turn), "test")


near = st.floats(-2.5, 2.5)
sides = st.floats(0.1, 2.5)


@given(st.tuples(near, near, near), st.floats(-180, 180), st.floats(-180, 180), sides, sides, st.integers(0, 2**31))
@settings(deadline=None)
def test_box_intersection_against_points(centre, yaw, other_yaw, side, other_side, seed):
    """A point in both boxes proves an intersection; and the answer is symmetric."""
    gate, other, depth = Gate((0.0, 0.0, 0.0), yaw), Gate(centre, other_yaw), 0.3
    answer = boxes_intersect(gate, side, other, other_side, depth)
    assert answer == boxes_intersect(other, other_side, gate, side, depth)
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5
    points *= torch.tensor([depth, side, side])
    world = points @ _axes(gate)
    local = (world - torch.tensor(centre, dtype=torch.float64)) @ _axes(other).mT
    in_other = (local.abs() < torch.tensor([depth, other_side, other_side]) / 2).all(-1).any()
    assert answer or not in_other


def _axes(gate: Gate) -> torch.Tensor:
    return torch.tensor([gate.forward, gate.left, (0.0, 0.0, 1.0)], dtype=torch.float64)


# ---------------------------------------------------------------- any file at all; tests/robustness spoils tracks


@pytest.fixture(scope="module")
def scratch_file(tmp_path_factory):
    return tmp_path_factory.mktemp("tracks") / "any.yaml"


@given(text=st.text(alphabet="{}[]:-,&*!|>#'\"\n\t ab1.", max_size=60))
@settings(deadline=None)
def test_any_text_is_a_track_or_a_refusal(scratch_file, text):
    scratch_file.write_text(text, encoding="utf-8")
    _load_or_refuse(scratch_file)


def _load_or_refuse(path: Path) -> None:
    try:
        track = load_track(path)
    except TrackError as refusal:
        message = str(refusal)
    else:
        message = f"{path}: {track.num_gates} gates"
    assert message.startswith(f"{path}: ")


# ------------------------------------------------ decoys change only what is seen; displaced gates can be flown


def test_decoys_of_figure8_are_those_of_its_own_track_file():
    plain, decorated = load_track("figure8"), load_track("figure8_decoys")
    assert with_decoys("figure8", "paper") == with_decoys("figure8_decoys", "paper") == decorated
    assert dataclasses.replace(decorated, name=plain.name, decoys=()) == plain
    assert len(decorated.decoys) == 2


def test_decoys_are_taken_away_and_left_alone():
    assert with_decoys("figure8_decoys", "none") == with_decoys("figure8", None) == load_track("figure8")
    assert with_decoys("figure8_decoys", None).decoys
    mine = dataclasses.replace(load_track("circle"), decoys=(Gate((0.0, 0.0, 1.35), 0.0, kind="decoy"),))
    assert with_decoys(mine, "none").decoys == ()


def test_which_tracks_have_decoys():
    found = {name: decoys_for(load_track(name)) for name in BUILTIN_TRACKS}
    assert {name for name, decoys in found.items() if decoys == "paper"} == {"figure8", "figure8_decoys"}
    assert found["circle"] is None


def test_plain_tracks_are_other_races_than_each_other():
    races = [load_track(name).gates for name in PLAIN_TRACKS]
    assert len(set(races)) == len(races)
    assert set(races) == {load_track(name).gates for name in BUILTIN_TRACKS}


@pytest.mark.parametrize(
    ("track", "decoys", "words"),
    [
        ("circle", "paper", "decoys=paper .*figure8; track 'circle' has"),
        ("figure8", "many", "decoys=many: must be paper or none"),
    ],
)
def test_decoys_that_are_not_there(track, decoys, words):
    with pytest.raises(TrackError, match=words):
        with_decoys(track, decoys)


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_displaced_gates(name):
    track = load_track(name)
    farthest = widest = 0.0
    for seed in range(10):
        displaced = displace_gates(track, shift=0.3, turn_degrees=10.0, seed=seed)
        assert load_track(displaced) is displaced  # it can be flown
        assert displaced == displace_gates(track, 0.3, 10.0, seed) != displace_gates(track, 0.3, 10.0, seed + 1)
        assert dataclasses.replace(displaced, name=track.name, gates=track.gates) == track
        for old, new in zip(track.gates, displaced.gates, strict=True):
            farthest = max(farthest, math.dist(old.position, new.position))
            widest = max(widest, abs(new.yaw_degrees - old.yaw_degrees))
            assert old.position != new.position
    assert 0.27 < farthest <= 0.3
    assert 8.5 < widest <= 10.0


def test_displacements_that_cannot_be_flown_are_refused():
    with pytest.raises(TrackError, match=r"circle.*none of 1000 displacements by up to 50"):
        displace_gates(load_track("circle"), shift=50.0, turn_degrees=0.0, seed=0)
