"""`recipes/sim_to_real.py` before anything flies."""

from __future__ import annotations

import json

import pytest

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.plant.study import StudyFlight
from tests.running_recipes import recipe_module

sim_to_real = recipe_module("sim_to_real")


def test_an_actor_of_another_track_is_refused():
    assert sim_to_real.check(sim_to_real.SimToRealConfig(actor="kidney"))[0] == load_track("kidney")
    with pytest.raises(ValueError, match="source.track is 'kidney', .* track=circle"):
        sim_to_real.check(sim_to_real.SimToRealConfig(actor="kidney", track="circle"))


def test_the_pilot_is_not_flown_beside_itself():
    with pytest.raises(ValueError, match="beside=pilot and actor=pilot"):
        sim_to_real.check(sim_to_real.SimToRealConfig(track="circle", beside="pilot"))


def test_agent_and_pilot_come_of_one_command(monkeypatch, tmp_path):
    made = []

    def flown(make_flyer, track, *others):
        made.append(make_flyer.func.__name__)
        yield StudyFlight("delay", 0.0, 0, 18, True, 4.0 + len(made), 9.0, "over")

    monkeypatch.setattr(sim_to_real, "study", flown)
    monkeypatch.setattr("sys.argv", ["sim_to_real", "actor=kidney", "beside=pilot", f"run_dir={tmp_path}", "flights=1"])
    sim_to_real.main()
    assert made == ["ActorFlyer", "PilotFlyer"]
    for name, actor, lap in (("sim_to_real", "kidney", 5.0), ("sim_to_real_pilot", "pilot", 6.0)):
        result = json.loads((tmp_path / f"{name}.json").read_text())
        assert result["provenance"]["actor"] == actor and result["flights"][0]["lap_time"] == lap
    assert (tmp_path / "sim_to_real.png").stat().st_size > 1000
