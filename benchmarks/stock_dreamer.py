"""Benchmark of TorchRL's own DreamerV3, timed like ours in ``learner.py``: one update of its stock modules and losses.

The assembly and its numbers are those of TorchRL's recipe: block GRU, strided convolutions, ``DreamerV3Loss`` over the
three losses and the replayed returns, ``DreamerV3Optimizer``, a slow critic, and ``DreamerV3OptimizationStepper`` with
its defaults, which are eager on a CPU and a compiled update in a CUDA graph on a GPU. Images are 64×64×3, with four
continuous actions. ``StockActor`` replaces the recipe's continuous actor, which is not a class of TorchRL.

    shape   belief  units  latents  CNN depth  parameters  GFLOP (B 8, T 32, H 15)  (B 16, T 64, H 16)
    small      512    128    16×16          8      1.37 M                       26
    large     2048    768    32×32         64      36.8 M                                        3,447

Channels are 1, 2, 4 and 4 times the depth, not TorchRL's default of 2, 3, 4 and 4, which takes half again as many
FLOPs in ``large`` (38.4 M parameters, 5,108 GFLOP): a wider peer would look slower than it is.

Each shape has two variants. The stock variant records a graph in imagination that REINFORCE never uses, and multiplies
at the highest float32 precision. ``tuned`` imagines without gradients, for which TorchRL has no option, sets
``float32_matmul_precision`` to high, on a GPU to medium (on a CPU with AMX, medium would mean bfloat16), keeps freed
memory as ``learner.py`` does for ours, and on a GPU trains in bfloat16.

Shape legend: B batch, T time, H horizon.

Reference: TorchRL 0.14, ``sota-implementations/dreamer_v3``.
"""

from dataclasses import dataclass
from typing import Any

import torch
from learner import parameters, random_rollout, time_updates
from tensordict import TensorDict
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.model_based import DreamerEnv
from torchrl.modules import (
    DreamerV3ImageDecoder,
    DreamerV3ImageEncoder,
    DreamerV3MLP,
    IndependentNormal,
    RSSMPosteriorV3,
    RSSMPriorV3,
    RSSMRolloutV3,
    SymExpTwoHot,
    WorldModelWrapper,
)
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3Loss, DreamerV3ModelLoss, DreamerV3ValueLoss, SoftUpdate
from torchrl.objectives.utils import ValueEstimators
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper, DreamerV3Optimizer

IMAGE = (3, 64, 64)  # channels first, pixels
ACTION_DIM = 4
CNN_MULTIPLIERS = (1, 2, 4, 4)
UNIMIX = 0.01
CONTINUATION_HORIZON = 333.0  # steps; the discount is in the continuation's targets, hence gamma = 1
LATENT = ["belief", "state"]
NEXT_LATENT = [("next", "belief"), ("next", "state")]


@dataclass(frozen=True)
class StockShape:
    """Widths of TorchRL's networks, whose depths are those of the recipe.

    Attributes:
        belief: Width of the block GRU's state.
        units: Width of the hidden layers of RSSM and heads.
        latents: Number of categorical latents.
        classes: Number of classes per latent.
        cnn_depth: Unit of a convolution's channels, which are ``CNN_MULTIPLIERS`` times as many.
    """

    belief: int
    units: int
    latents: int
    classes: int
    cnn_depth: int

    @property
    def state(self) -> int:
        """Width of the stochastic state, flattened one-hots."""
        return self.latents * self.classes

    @property
    def features(self) -> int:
        """Input width of the heads."""
        return self.belief + self.state


SHAPES = {
    "small": StockShape(belief=512, units=128, latents=16, classes=16, cnn_depth=8),
    "large": StockShape(belief=2048, units=768, latents=32, classes=32, cnn_depth=64),
}


def measure_stock(
    batch: tuple[int, int],
    horizon: int,
    device: str,
    threads: int,
    updates: int,
    shape: str = "small",
    tuned: bool = False,
) -> dict[str, Any]:
    """Time updates of one shape and variant; return one record with the columns of ``learner.py``.

    Args:
        batch: Number of sequences B and their length T.
        horizon: Imagined steps from each of the B T states.
        device: Device of the update.
        threads: Number of torch threads.
        updates: Number of timed updates, after 3 of warm-up.
        shape: Key of ``SHAPES``.
        tuned: Whether to time the ``tuned`` variant.
    """
    torch.set_num_threads(threads)
    cuda = device.startswith("cuda")
    precision = ("medium" if cuda else "high") if tuned else "highest"
    torch.set_float32_matmul_precision(precision)
    torch.manual_seed(0)
    stepper = make_stepper(SHAPES[shape], horizon, device, tuned)
    sample = make_sample(SHAPES[shape], batch, device)
    compiled, captured = stepper.resolve(torch.device(device))

    def update() -> None:
        stepper.step(None, sample)

    def first_update() -> None:
        if compiled or captured:
            stepper.warmup(sample)
        update()

    backend = "+".join(name for name, used in (("compile", compiled), ("graph", captured)) if used) or "eager"
    timed = time_updates(
        update, updates, device, tuned and cuda, lambda: count_flops(stepper, sample), backend == "eager", first_update
    )
    changes = f"+no_grad+{precision}" + ("+bf16" if cuda else "") if tuned else ""
    return {
        "benchmark": "learner", "size": f"torchrl {shape}", "loss": "reconstruction", "actor": "reinforce",
        "backend": backend + changes, "batch": "x".join(map(str, batch)), "horizon": horizon,
        "parameters": parameters(stepper), **timed, "sample_share": None,
    }  # fmt: skip


class StockActor(nn.Module):
    """Normal distribution over actions, with mean and standard deviation as in TorchRL's recipe."""

    def __init__(self, shape: StockShape) -> None:
        super().__init__()
        self.mlp = DreamerV3MLP(shape.features, 2 * ACTION_DIM, 3, shape.units, outscale=0.01)

    def forward(self, belief: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, [..., 4] each."""
        mean, std = self.mlp(belief, state).float().chunk(2, -1)
        return mean.tanh(), 0.9 * torch.sigmoid(std + 2) + 0.1


class GradientFreeEnv(DreamerEnv):
    """Imagination without an autograd graph, which REINFORCE does not need."""

    @torch.no_grad()
    def rollout(self, *args: Any, **kwargs: Any) -> TensorDict:
        """Imagine as ``DreamerEnv`` does."""
        return super().rollout(*args, **kwargs)


def make_stepper(shape: StockShape, horizon: int, device: str, tuned: bool = False) -> DreamerV3OptimizationStepper:
    """Build losses, optimiser and slow critic on a device."""
    losses = make_losses(shape, horizon, device, tuned)
    slow_critic = SoftUpdate(losses.value_loss, tau=0.02)
    trained = [
        *losses.model_loss.parameters(),
        *losses.actor_loss.actor_model.parameters(),
        *losses.value_loss.parameters(),
    ]
    return DreamerV3OptimizationStepper(losses, DreamerV3Optimizer(trained), slow_critic, mixed_precision=tuned)


def make_losses(shape: StockShape, horizon: int, device: str, tuned: bool = False) -> DreamerV3Loss:
    """Build the networks and all losses on a device."""
    prior = RSSMPriorV3(
        action_shape=(ACTION_DIM,), action_dim=ACTION_DIM, hidden_dim=shape.units, rnn_hidden_dim=shape.belief,
        num_categoricals=shape.latents, num_classes=shape.classes, recurrent_model="block_gru", unimix=UNIMIX,
    )  # fmt: skip
    reward = DreamerV3MLP(shape.features, 255, 1, shape.units, outscale=0.0)
    continuation = DreamerV3MLP(shape.features, 1, 1, shape.units)
    value = TensorDictSequential(
        *head(DreamerV3MLP(shape.features, 255, 3, shape.units, outscale=0.0), LATENT, "state_value_logits"),
        TensorDictModule(SymExpTwoHot(), in_keys=["state_value_logits"], out_keys=["state_value"]),
    )
    model_loss = DreamerV3ModelLoss(
        make_world_model(shape, prior, reward, continuation).to(device),
        kl_mode="separate", unimix=UNIMIX, lambda_continue=1.0, continue_target_scale=1 - 1 / CONTINUATION_HORIZON,
        reco_symlog=False, detach_output=False,
    ).to(device)  # fmt: skip
    actor_loss = DreamerV3ActorLoss(
        make_actor(shape).to(device),
        value.to(device),
        make_imagination(shape, prior, reward, device, GradientFreeEnv if tuned else DreamerEnv),
        continuation_model=TensorDictSequential(
            *head(continuation, LATENT, "continue_logits"),
            TensorDictModule(nn.Sigmoid(), in_keys=["continue_logits"], out_keys=["continuation"]),
        ),
        imagination_horizon=horizon,
        use_reinforce=True,
    )
    actor_loss.make_value_estimator(ValueEstimators.TDLambda, gamma=1.0, lmbda=0.95)
    value_loss = DreamerV3ValueLoss(value, "two_hot", actor_loss=actor_loss, slow_critic_regularization=1.0)
    return DreamerV3Loss(model_loss, actor_loss.to(device), value_loss.to(device))


def head(network: nn.Module, in_keys: list[Any], out_key: Any) -> tuple[TensorDictModule, TensorDictModule]:
    """Return a network as a module on keys and, as in the recipe, a cast of its output to float32."""
    return (
        TensorDictModule(network, in_keys=in_keys, out_keys=[out_key]),
        TensorDictModule(Tensor.float, in_keys=[out_key], out_keys=[out_key]),
    )


def make_world_model(
    shape: StockShape, prior: RSSMPriorV3, reward: DreamerV3MLP, continuation: DreamerV3MLP
) -> TensorDictSequential:
    """Chain encoder, RSSM, decoder and heads over sequences [B, T]."""
    encoder = DreamerV3ImageEncoder(depth=shape.cnn_depth, mults=CNN_MULTIPLIERS)
    decoder = DreamerV3ImageDecoder(shape.features, IMAGE, shape.cnn_depth, CNN_MULTIPLIERS)
    posterior = RSSMPosteriorV3(
        hidden_dim=shape.units, num_categoricals=shape.latents, num_classes=shape.classes, unimix=UNIMIX,
        rnn_hidden_dim=shape.belief, obs_embed_dim=encoder.output_features(IMAGE), use_rms_norm=True,
    )  # fmt: skip
    return TensorDictSequential(
        TensorDictModule(encoder, in_keys=[("next", "pixels")], out_keys=[("next", "encoded_latents")]),
        RSSMRolloutV3(
            TensorDictModule(
                prior,
                in_keys=["state", "belief", "action"],
                out_keys=[("next", "prior_logits"), ("next", "state"), ("next", "belief")],
            ),
            TensorDictModule(
                posterior,
                in_keys=[("next", "belief"), ("next", "encoded_latents")],
                out_keys=[("next", "posterior_logits"), ("next", "state")],
            ),
        ),
        *head(decoder, NEXT_LATENT, ("next", "reco_pixels")),
        *head(reward, NEXT_LATENT, ("next", "reward_logits")),
        TensorDictModule(SymExpTwoHot(), in_keys=[("next", "reward_logits")], out_keys=[("next", "reward")]),
        *head(continuation, NEXT_LATENT, ("next", "continue_pred")),
    )


def make_actor(shape: StockShape) -> ProbabilisticTensorDictSequential:
    """Return the policy."""
    return ProbabilisticTensorDictSequential(
        TensorDictModule(StockActor(shape), in_keys=LATENT, out_keys=["loc", "scale"]),
        ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"],
            out_keys=["action"],
            distribution_class=IndependentNormal,
            default_interaction_type=InteractionType.RANDOM,
            return_log_prob=True,
            log_prob_key="action_log_prob",
        ),
    )


def make_imagination(
    shape: StockShape, prior: RSSMPriorV3, reward: DreamerV3MLP, device: str, environment_class: type[DreamerEnv]
) -> DreamerEnv:
    """Return the environment in which the actor imagines; it shares prior and reward head with the world model."""
    environment = environment_class(
        WorldModelWrapper(
            TensorDictModule(prior, in_keys=["state", "belief", "action"], out_keys=["_", "state", "belief"]),
            TensorDictSequential(
                *head(reward, LATENT, "reward_logits"),
                TensorDictModule(SymExpTwoHot(), in_keys=["reward_logits"], out_keys=["reward"]),
            ),
        ),
        prior_shape=(shape.state,),
        belief_shape=(shape.belief,),
        device=device,
    )
    environment.observation_spec = Composite(state=Unbounded(shape.state), belief=Unbounded(shape.belief)).to(device)
    environment.state_spec = environment.observation_spec.clone()
    environment.action_spec = Bounded(-1, 1, (ACTION_DIM,), device=device)
    environment.reward_spec = Unbounded((1,), device=device)
    return environment


def make_sample(shape: StockShape, batch: tuple[int, int], device: str) -> TensorDict:
    """Return random sequences [B, T] with TorchRL's keys; all start from latents of zero."""
    records = random_rollout(*batch)
    following = records["next"].select("reward", "terminated")
    following["done"] = following["terminated"].clone()
    following["pixels"] = records["next", "pixels"].movedim(-1, -3).contiguous()
    latents = {"state": torch.zeros(*batch, shape.state), "belief": torch.zeros(*batch, shape.belief)}
    return TensorDict({**records.select("action", "is_init"), **latents, "next": following}, batch).to(device)


class FlopCounter(TorchDispatchMode):
    """Counter by torch's FLOP formulas; ``FlopCounterMode`` itself fails on the ``TensorDictParams`` of the losses."""

    def __init__(self) -> None:
        super().__init__()
        self.total = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        formula = flop_registry.get(func._overloadpacket)
        if formula is not None:
            self.total += formula(*args, **(kwargs or {}), out_val=result)
        return result


def count_flops(stepper: DreamerV3OptimizationStepper, sample: TensorDict) -> int:
    """Count the FLOPs of the losses and their gradients in an additional eager pass, without an optimiser step."""
    with FlopCounter() as counter:
        losses = stepper.loss_module(sample)
        torch.stack([value for key, value in losses.items() if key.startswith("loss_")]).sum().backward()
    stepper.optimizer.zero_grad(set_to_none=False)
    return counter.total
