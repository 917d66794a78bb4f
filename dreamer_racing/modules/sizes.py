"""Model sizes by name: all numbers that determine the shapes of the agent's networks."""

from __future__ import annotations

from dataclasses import dataclass, replace

from dreamer_racing.settings import COUNT, check_choice, check_setting


@dataclass(frozen=True)
class ModelSize:
    """Widths and variants of all networks.

    Attributes:
        name: Key in ``SIZES``, or any name for your own size.
        belief: Width of the recurrent state h.
        hidden: Width of the RSSM's inner layers.
        latents: Number of categorical latents in z.
        classes: Classes of each categorical latent.
        units: Width of the reward, continue, actor and critic layers.
        recurrence: ``"block"`` (2025 block GRU) or ``"dense"`` (2023 GRU).
        blocks: Diagonal blocks of the block GRU and of the decoder's first layer (1: dense decoder input).
        prior_layers: Hidden layers from h to the prior's logits.
        head_layers: Hidden layers of the reward and continue heads.
        actor_critic_layers: Hidden layers of actor and critic.
        vector_layers: Hidden layers, ``units`` wide, of the encoder and decoder of vectors.
        norm: ``"rms"`` or ``"layer"``; layer norm is much cheaper on a CPU.
        learned_initial: Whether an episode's first h is learned (2023) or zero (2025).
        cnn_depth: Channels of a convolution are ``cnn_depth * multiplier``.
        cnn_multipliers: One multiplier for each halving of the image.
        cnn_kernel: Kernel size of every convolution, pixels.
        strided: Halve by stride 2 (a quarter of the FLOPs) rather than by 2×2 max-pool.
        cnn_patch: Side of the pixel blocks folded into channels before the first convolution (1: none). With 2, the
            largest maps and their normalisation disappear, at nearly the same FLOPs.
        bins: Bins of the two-hot reward and value distributions.
        sampled: Whether z is a sample of its categoricals, as in DreamerV3, or their probabilities (an extension: the
            latents are then deterministic, and so is imagination except for the actor's noise).
        state_std: Whether the standard deviation of actions depends on the state, as in DreamerV3, or is one learned
            number for each dimension of the action, as usual with PPO.
    """

    name: str
    belief: int
    hidden: int
    classes: int
    units: int
    cnn_depth: int
    latents: int = 32
    recurrence: str = "block"
    blocks: int = 8
    prior_layers: int = 2
    head_layers: int = 1
    actor_critic_layers: int = 3
    vector_layers: int = 3
    norm: str = "rms"
    learned_initial: bool = False
    cnn_multipliers: tuple[int, ...] = (2, 3, 4, 4)
    cnn_kernel: int = 5
    strided: bool = False
    cnn_patch: int = 1
    bins: int = 255
    sampled: bool = True
    state_std: bool = True

    def __post_init__(self) -> None:
        """Refuse sizes of which no sound networks can be made.

        Raises:
            ValueError: The message names the field.
        """
        check_choice("norm", self.norm, ("rms", "layer"))
        check_choice("recurrence", self.recurrence, ("block", "dense"))
        for name in ("blocks", "prior_layers", "head_layers", "actor_critic_layers", "vector_layers"):
            check_setting(name, getattr(self, name), COUNT, whole=True)
        channels = self.cnn_depth * self.cnn_multipliers[-1]
        for name, width in (("belief", self.belief), ("cnn_depth times the last of cnn_multipliers", channels)):
            if width % self.blocks:
                raise ValueError(f"{name}={width}: must be a multiple of blocks={self.blocks}.")
        if self.sampled and self.classes > 256:
            raise ValueError(f"classes={self.classes}: at most 256, as the replay stores a class in a byte.")

    @property
    def state(self) -> int:
        """Width of the state z: flattened one-hots or, if not ``sampled``, probabilities."""
        return self.latents * self.classes

    @property
    def features(self) -> int:
        """Width of the heads' input, h and z side by side."""
        return self.belief + self.state


def _reference(name: str, belief: int, hidden: int, classes: int) -> ModelSize:
    """Return a size of the 2025 reference, where ``cnn_depth`` equals ``classes``, and ``units`` equals ``hidden``."""
    return ModelSize(name, belief=belief, hidden=hidden, classes=classes, units=hidden, cnn_depth=classes)


_CPU = ModelSize(
    "cpu_small",
    belief=256,
    hidden=128,
    latents=16,
    classes=16,
    units=128,
    cnn_depth=16,
    recurrence="dense",
    blocks=1,
    prior_layers=1,
    actor_critic_layers=2,
    vector_layers=2,
    norm="layer",
    cnn_multipliers=(1, 2, 4),
    cnn_kernel=4,
    strided=True,
    cnn_patch=2,
)
"""Size that is cheap on a CPU: fused layer norm, few calls per recurrent step, strided convolutions on folded pixels.

Channels in multiples of 16 fill the vector registers: 16-32-64 takes 60 % of the time of 24-36-48."""


def _paper(name: str, belief: int, units: int, layers: int, cnn_depth: int) -> ModelSize:
    """Return a size of the 2023 reference, with the paper's architecture instead of the block GRU."""
    return ModelSize(
        name,
        belief=belief,
        hidden=units,
        classes=32,
        units=units,
        cnn_depth=cnn_depth,
        recurrence="dense",
        blocks=1,
        prior_layers=1,
        head_layers=layers,
        actor_critic_layers=layers,
        vector_layers=layers,
        norm="layer",
        learned_initial=True,
        cnn_multipliers=(1, 2, 4, 8),
        cnn_kernel=4,
        strided=True,
    )


SIZES: dict[str, ModelSize] = {
    size.name: size
    for size in (
        replace(_CPU, name="debug", belief=32, hidden=16, latents=4, classes=4, units=16, cnn_depth=2,
                actor_critic_layers=1, vector_layers=1),
        _CPU,
        _reference("size1m", 512, 64, 4),
        _reference("size12m", 2048, 256, 16),
        _reference("size25m", 3072, 384, 24),
        _reference("size50m", 4096, 512, 32),
        _reference("size100m", 6144, 768, 48),
        _reference("size200m", 8192, 1024, 64),
        _paper("paper_small", 512, 512, 2, 32),
        _paper("paper_medium", 1024, 640, 3, 48),
        _paper("paper_large", 2048, 768, 4, 64),
        # The widths of paper_large with the block GRU, the heads and the convolutions of TorchRL's stock agent.
        replace(_paper("block_large", 2048, 768, 3, 64), recurrence="block", blocks=8, learned_initial=False,
                head_layers=1, cnn_multipliers=(1, 2, 4, 4)),
    )
}  # fmt: skip
"""Sizes by name.

Reference: ``size*`` are from danijar/dreamerv3 ``configs.yaml``; ``paper_*`` are S, M and L of Hafner et al. 2023,
Appendix B, of which Dream to Fly uses L."""


def get_size(size: ModelSize | str) -> ModelSize:
    """Return the size of a name, a key of ``SIZES``, or a given ``ModelSize`` as it is.

    Raises:
        ValueError: If no size has that name; the message lists the known names.

    Example:
        >>> get_size("size12m").belief
        2048
    """
    if isinstance(size, ModelSize):
        return size
    check_choice("model", size, SIZES)
    return SIZES[size]
