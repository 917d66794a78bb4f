"""Looks that change from episode to episode, the same from every renderer."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dreamer_racing.envs.simulator.looks import LooksRandomisation, load_looks
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.worlds import RaceWorlds
from tests.renderers import IN_PROCESS, renderer_or_skip

N = 6
QUIET = LooksRandomisation(noise=0.0)
NOTHING = LooksRandomisation(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def worlds(looks: str | LooksRandomisation | None, renderer: str = "auto", seed: int = 0, **arguments) -> RaceWorlds:
    made = RaceWorlds("kidney", N, evaluation=True, looks=looks, renderer=renderer, seed=seed, **arguments)
    made.reset()
    return made


def images(looks: str | LooksRandomisation | None, renderer: str = "warp", **arguments) -> Tensor:
    made = worlds(looks, renderer, **arguments)
    drawn = made.render().float()
    made.close()
    return drawn


@pytest.mark.parametrize("renderer", IN_PROCESS)
def test_worlds_look_different_and_only_if_asked(renderer: str) -> None:
    renderer_or_skip(renderer)
    nominal, varied = images(None, renderer), images(QUIET, renderer)
    assert (nominal[1:] == nominal[0]).all()  # all start at the same place
    for one in range(N):
        for other in range(one):
            assert (varied[one] - varied[other]).abs().mean() > 1.0
    assert (images(NOTHING, renderer) - nominal).abs().mean() < 0.2


@pytest.mark.parametrize("renderer", [name for name in IN_PROCESS if name != "egl"])
def test_renderers_agree_about_looks(renderer: str) -> None:
    for name in ("egl", renderer):
        renderer_or_skip(name)
    made = [worlds(QUIET, "egl"), worlds(QUIET, renderer), worlds(QUIET, backend="mujoco_warp")]
    for each in made[1:]:
        each.simulator.load_state_dict(made[0].simulator.state_dict())
    first, *others = (each.render().float() for each in made)
    for other in others:
        assert (first - other).abs().mean() < 3.0
    for each in made:
        each.close()


@pytest.mark.parametrize(
    ("name", "value"), [("brightness", 0.5), ("color", 0.5), ("gate_color", 0.5), ("camera_tilt", 10.0)]
)
def test_each_width_has_its_effect(name: str, value: float) -> None:
    varied = images(LooksRandomisation(**{**vars(NOTHING), name: value}))
    difference = (varied - images(None)).abs()
    assert (difference.mean((1, 2, 3)) > 0.1).all()
    if name == "brightness":  # every pixel that is not saturated becomes darker or brighter alike
        darker, brighter = (varied < images(None)).flatten(1), (varied > images(None)).flatten(1)
        assert not (darker.any(1) & brighter.any(1)).any()


def test_a_wider_lens_shows_gates_smaller() -> None:
    made = worlds(LooksRandomisation(**{**vars(NOTHING), "field_of_view": 20.0}))
    looks = made.simulator.looks.looks
    red, green, blue = made.render().float().unbind(-1)
    orange = ((red > 140) & (green < 100) & (blue < 60)).flatten(1).sum(1)
    order = looks.field_of_view.argsort()
    assert (orange[order].diff() <= 0).all()
    assert orange[order[0]] > 1.2 * orange[order[-1]]
    made.close()


def test_an_episode_keeps_its_looks_and_the_next_has_others() -> None:
    made = worlds(QUIET)
    before = made.simulator.looks.state_dict()
    mask = torch.tensor([True, False] * (N // 2))
    made.step(torch.zeros(N, 4))
    made.reset(mask)
    after = made.simulator.looks.state_dict()
    for name, value in after.items():
        assert torch.equal(value[~mask], before[name][~mask])
        assert (value[mask] != before[name][mask]).reshape(N // 2, -1).any(1).all()
    made.close()


def test_gates_and_surfaces_vary_apart() -> None:
    made = worlds(LooksRandomisation(**{**vars(NOTHING), "gate_color": 0.2}))
    looks = made.simulator.looks
    changed = (looks.looks.colors != looks._nominal).flatten(2).any(2)  # (N, K)
    assert changed.sum(1).tolist() == [1] * N  # kidney's gates share one colour
    made.close()


def test_noise_is_of_the_width_asked_for_and_new_in_every_image() -> None:
    made = worlds(LooksRandomisation(**{**vars(NOTHING), "noise": 0.02}))
    clean, first, second = made.simulator.render().float(), made.render().float(), made.render().float()
    inner = (clean > 30) & (clean < 225)  # not cut off
    assert (first - clean)[inner].std() == pytest.approx(0.02 * 255, rel=0.05)
    assert abs(float((first - clean)[inner].mean())) < 0.1
    assert not torch.equal(first, second)
    made.close()


@pytest.mark.parametrize(("saved", "present"), [(None, "randomised"), ("randomised", None)])
def test_a_state_with_other_looks_is_refused(saved: str | None, present: str | None) -> None:
    one, other = worlds(saved), worlds(present)
    name = saved or "nominal"
    with pytest.raises(ValueError, match=f"The saved worlds have {name} looks.*resume with looks={name}"):
        other.load_state_dict(one.state_dict())
    one.close()
    other.close()


def test_bad_looks_are_refused() -> None:
    with pytest.raises(ValueError, match="looks='pretty': use nominal, randomised"):
        load_looks("pretty")
    with pytest.raises(ValueError, match="or a LooksRandomisation"):
        load_looks({"noise": 0.1})
    with pytest.raises(ValueError, match="noise=-1.0 must not be negative"):
        LooksRandomisation(noise=-1.0)
    with pytest.raises(ValueError, match="below 1"):
        LooksRandomisation(brightness=1.0)
    with pytest.raises(ValueError, match="gate_color=inf must not be negative, and finite"):
        LooksRandomisation(gate_color=math.inf)
    with pytest.raises(ValueError, match="camera_tilt='3': must be a number"):
        LooksRandomisation(camera_tilt="3")


@pytest.mark.parametrize(("lens", "width", "most"), [(90.0, 95.0, 90), (90.0, 90.0, 90), (120.0, 60.0, 60)])
def test_lenses_vary_no_further_than_there_are_any(lens: float, width: float, most: int) -> None:
    with pytest.raises(ValueError, match=f"field_of_view={width}: around the camera's {lens:g} .* below {most}"):
        worlds(LooksRandomisation(field_of_view=width), "warp", camera=Camera(field_of_view=lens))
