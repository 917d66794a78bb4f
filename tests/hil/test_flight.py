"""Whole flights through the chain against the plant, in simulated time: flown, cut, stopped, and played back."""

from __future__ import annotations

import json
import os
import signal
from itertools import pairwise
from pathlib import Path

import pytest

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.hil.chain import describe_outputs, read_inputs
from dreamer_racing.hil.flyer import ActorFlyer, check_contract
from dreamer_racing.hil.loop import FAREWELL
from dreamer_racing.hil.recording import FILE, Flight, FlightRecorder
from dreamer_racing.hil.safety import State
from dreamer_racing.plant.pilot import PilotFlyer
from dreamer_racing.plant.vehicle import Mismatch, PlantVehicle
from tests.hil.flights import BEGAN, Hover, SimulatedTime, fly, make_chain

AGENTS = Path(__file__).parents[2] / "agents"
FIGURE8 = load_track("figure8")
CIRCLE = load_track("circle")


def test_the_pilot_flies_three_laps_with_delay_and_loss():
    flyer = PilotFlyer(FIGURE8, "faithful")
    time = SimulatedTime(PlantVehicle(FIGURE8, "faithful", Mismatch(delay=0.02)), loss=0.01)
    chain = make_chain(flyer, FIGURE8, speed_max=25.0)
    assert fly(flyer, time, chain) == "disarmed: the flight is over"
    assert [passed.gate for passed in chain.progress.passes] == [*range(6)] * 3
    assert time.vehicle.gates_passed == 18 and len(time.vehicle.lap_times) == 3
    # as the race itself saw them, to within the poses' period
    laps = [b.time - a.time for a, b in pairwise(chain.progress.passes[5::6])]
    assert laps == pytest.approx(time.vehicle.lap_times[1:], abs=0.03)


def test_a_shipped_agent_flies_by_its_images_and_its_flight_plays_back_bit_for_bit(tmp_path):
    flyer = ActorFlyer(AGENTS / "circle")
    track = load_track(flyer.contract["source"]["track"])
    time = SimulatedTime(PlantVehicle(track, "easy"))
    chain = make_chain(flyer, track, laps=1)
    with FlightRecorder(tmp_path / FILE, {}) as recorder:
        assert fly(flyer, time, chain, recorder) == "disarmed: the flight is over"
    chain.close()
    assert time.vehicle.gates_passed == 4
    again = make_chain(ActorFlyer(AGENTS / "circle"), track, laps=1)
    flight = Flight(tmp_path)
    assert flight.whole and len(flight.ticks) > 50
    for tick in flight.ticks:
        outputs = again.tick(read_inputs(tick["in"]))
        assert json.loads(json.dumps(describe_outputs(outputs))) == tick["out"]
    again.close()


def test_nothing_is_armed_without_leave():
    time = SimulatedTime(PlantVehicle(CIRCLE, "easy"))
    ended = fly(Hover(), time, make_chain(Hover(), CIRCLE, arm=False), duration=2.0)
    assert ended.startswith("2 s are over; not armed:") and "arm=true" in ended
    assert not any(command.armed for _, command in time.sent)


def test_lost_poses_are_held_then_cut_within_200_ms():
    def fault(elapsed: float) -> None:
        time.silent = elapsed > 2.0

    time = SimulatedTime(PlantVehicle(CIRCLE, "easy"), event=fault)
    ended = fly(Hover(), time, make_chain(Hover(), CIRCLE))
    assert ended.startswith("cut: ")
    last_armed = max(moment for moment, command in time.sent if command.armed)
    assert 2.05 < last_armed < 2.2
    assert not any(command.armed for moment, command in time.sent if moment > 2.2)


@pytest.mark.parametrize("armed", [True, False])
def test_the_operators_kill_wins_at_once(armed):
    def fault(elapsed: float) -> None:
        time.killed = elapsed > 1.5

    time = SimulatedTime(PlantVehicle(CIRCLE, "easy"), enable_after=0.5 if armed else 9.0, event=fault)
    fly(Hover(), time, make_chain(Hover(), CIRCLE), duration=3.0)
    assert any(command.armed for _, command in time.sent) == armed
    assert not any(command.armed for moment, command in time.sent if moment > 1.53)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_flight_with_a_second_of_disarm_frames(number):
    sent = []

    def fault(elapsed: float) -> None:
        if elapsed > 1.5 and not sent:
            sent.append(elapsed)
            os.kill(os.getpid(), number)

    time = SimulatedTime(PlantVehicle(CIRCLE, "easy"), event=fault)
    assert fly(Hover(), time, make_chain(Hover(), CIRCLE)) == number.name
    frames = [moment for moment, command in time.sent if moment > sent[0] + 0.03]
    assert not any(command.armed for moment, command in time.sent if moment in frames)
    assert frames[-1] - frames[0] == pytest.approx(FAREWELL, abs=0.05)


def test_whatever_breaks_the_vehicle_is_disarmed():
    class Broken(Hover):
        def act(self, pose, image, target_gate):
            if self.resets and pose.time > BEGAN + 1.5:
                raise RuntimeError("out of order")
            return super().act(pose, image, target_gate)

    time = SimulatedTime(PlantVehicle(CIRCLE, "easy"))
    with pytest.raises(RuntimeError, match="out of order"):
        fly(Broken(), time, make_chain(Broken(), CIRCLE))
    assert any(command.armed for _, command in time.sent)
    assert [command.armed for _, command in time.sent[-50:]] == [False] * 50


def test_the_actor_forgets_until_the_vehicle_moves():
    class Climb(Hover):
        def act(self, pose, image, target_gate):
            return super().act(pose, image, target_gate)._replace(collective_thrust=14.0)

    flyer = Climb()
    time = SimulatedTime(PlantVehicle(CIRCLE, "easy"))
    chain = make_chain(flyer, CIRCLE)
    ended = fly(flyer, time, chain)
    assert chain.safety.state is State.CUT and "fence" in ended
    began = next(moment for moment, command in time.sent if command.setpoint.collective_thrust > 13.0)
    assert began * 50 - 5 < flyer.resets < (began + 0.4) * 50


def test_after_a_stall_the_next_tick_is_late_and_those_after_it_are_on_the_grid():
    class Stalls(SimulatedTime):
        def send(self, command):
            sent = super().send(command)
            if self.time - BEGAN == pytest.approx(1.0):
                self.sleep_until(self.time + 0.075)  # three periods are missed, and most of a fourth
            return sent

    time = Stalls(PlantVehicle(CIRCLE, "easy"))
    fly(Hover(), time, make_chain(Hover(), CIRCLE), duration=1.3)
    moments = [moment for moment, _ in time.sent if 0.97 < moment <= 1.17]
    assert moments == pytest.approx([0.98, 1.0, 1.075, 1.08, 1.1, 1.12, 1.14, 1.16])


def test_a_contract_that_does_not_fit_is_refused_with_what_differs():
    contract = ActorFlyer(AGENTS / "kidney").contract
    check_contract(contract, "kidney", 25.0)
    with pytest.raises(
        ValueError, match=r"source.track is 'kidney', and track=circle; control.rate_hz is 25, and rate=50"
    ):
        check_contract(contract, "circle", 50.0)
    with pytest.raises(ValueError, match=r"camera says images of \[1, 96, 64, 3\], and the input image_u8 is"):
        check_contract({**contract, "camera": {**contract["camera"], "height_px": 96}}, "kidney")
