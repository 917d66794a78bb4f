"""The kernels compute what `Quadrotor` and `RigidStep` state in torch, for drones in every condition."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import PRESETS, QuadrotorParameters
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rigid_step import RigidStep
from dreamer_racing.envs.simulator.fused_flight import FusedFlight

N = 256
DELAYED = QuadrotorParameters(command_delay=0.045)


def state(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Tumbling drones at random: qpos (N, 7) and qvel (N, 6)."""
    draw = torch.randn(N, 13, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    attitude = torch.nn.functional.normalize(draw[:, 3:7], dim=1)
    return torch.cat((draw[:, :3], attitude), 1), torch.cat((6.0 * draw[:, 7:10], 8.0 * draw[:, 10:]), 1)


class Bodies:
    """Bodies that gain speed as if nothing held them, in place of MuJoCo's."""

    def __init__(self) -> None:
        self.qpos, self.qvel = state()
        self.force = torch.zeros(N, 6, dtype=torch.float64)

    def integrate(self) -> None:
        self.qvel += 0.002 * self.force * torch.tensor([1.0, 1.0, 1.0, 100.0, 100.0, 100.0])
        self.qpos[:, :3] += 0.002 * self.qvel[:, :3]


@pytest.mark.parametrize("parameters", [*PRESETS.values(), DELAYED], ids=[*PRESETS, "late"])
def test_kernels_do_what_torch_does(parameters: QuadrotorParameters) -> None:
    quadrotor = Quadrotor(parameters, N, generator=torch.Generator().manual_seed(1))
    quadrotor.reset(torch.ones(N, dtype=torch.bool))
    quadrotor.rotor_speed.uniform_(0.0, 2.0)
    other = copy.deepcopy({name: value for name, value in vars(quadrotor).items() if name != "_generator"})
    reference = Quadrotor(parameters, N, generator=torch.Generator().manual_seed(1))
    vars(reference).update(other)
    ours, theirs = Bodies(), Bodies()
    fused = FusedFlight(quadrotor, ours.qpos, ours.qvel, ours.force, ours.integrate)
    flight = RigidStep(reference, theirs.qpos, theirs.qvel, theirs.force, theirs.integrate)
    generator = torch.Generator().manual_seed(2)
    for _ in range(4):
        action = 2.4 * torch.rand(N, 4, generator=generator, dtype=torch.float64) - 1.2
        path = [theirs.qpos[:, :3].clone()]
        quadrotor.command(action)
        reference.command(action)
        flown = fused.fly()
        for index in range(parameters.physics_steps):
            flight.step(index)
            path.append(theirs.qpos[:, :3].clone())
        for one, expected in (
            (ours.force, theirs.force), (ours.qpos, theirs.qpos), (ours.qvel, theirs.qvel),
            (quadrotor.rotor_speed, reference.rotor_speed), (flown, torch.stack(path)),
            (quadrotor.effort, reference.effort),
        ):  # fmt: skip
            # the square root of a rotor thrust of 0 plus a rounding error of 1e-17 N is 3e-9
            torch.testing.assert_close(one, expected, rtol=1e-7, atol=1e-7)
    assert (quadrotor.effort.amin(0) >= 0.0).all() and (quadrotor.effort.amax(0) > 0.2).all()
    assert (quadrotor.rotor_speed < 0.3).any()  # some rotors were at their limits
    assert (quadrotor.rotor_speed > 1.9).any()


def test_a_broken_drone_breaks_alone_and_visibly() -> None:
    bodies = Bodies()
    bodies.qvel[3, 4] = float("nan")
    path = FusedFlight(Quadrotor(PRESETS["easy"], N), bodies.qpos, bodies.qvel, bodies.force, bodies.integrate).fly()
    finite = path.isfinite().all(2).all(0)
    assert not finite[3]
    assert finite.sum() == N - 1
