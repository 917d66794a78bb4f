"""What a saved `DreamerLearner` holds of its losses, and whether it fits the learner that loads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any, NamedTuple

from torch import Tensor, nn
from torchrl.objectives import LossModule

from dreamer_racing.modules import Agent, Interface, ModelSize

VARIANTS = ("sampled", "state_std")
"""What of a `ModelSize` the command line chooses beside the size, as ``model.sampled=false``."""


def own_state(loss: LossModule, agent: Agent) -> dict[str, Tensor]:
    """Return a loss's state without that of the agent's networks, which it holds under whatever names."""
    shared = {id(tensor) for tensor in agent.state_dict(keep_vars=True).values()}
    state = loss.state_dict(keep_vars=True)
    return {key: tensor.detach() for key, tensor in state.items() if id(tensor) not in shared}


class LossState:
    """A loss as a part of a checkpoint: what it has and keeps, without the networks.

    Args:
        loss: Of any of them.
        agent: Whose networks it trains.
    """

    def __init__(self, loss: LossModule, agent: Agent) -> None:
        self._loss = loss
        self._agent = agent

    def state_dict(self) -> dict[str, Tensor]:
        """Return it."""
        return own_state(self._loss, self._agent)

    def load_state_dict(self, state_dict: dict[str, Tensor]) -> None:
        """Restore what ``state_dict`` returned."""
        self._loss.load_state_dict(state_dict, strict=False)


def check_saved(saved: dict[str, Any], agent: Agent, losses: nn.ModuleDict) -> None:
    """Refuse what another learner saved.

    Args:
        saved: ``state_dict()`` of a learner.
        agent: The networks that are to load it.
        losses: Theirs.

    Raises:
        ValueError: If it is that of a model of another size, of other losses or of another environment.
    """
    check_size(saved["size"], agent.size)
    parts = _networks(saved, agent)
    for name, loss in losses.items():
        # What a loss keeps from update to update it may do without; older versions keep less.
        kept = {key for key, _ in loss.named_buffers()}
        wanted, found = (
            {key: value for key, value in state.items() if key not in kept}
            for state in (own_state(loss, agent), saved["losses"][name])
        )
        parts[f"{name} loss"] = wanted, found
    _check_parts(parts, saved, agent)


class Unmatched(NamedTuple):
    """Networks of losses' own, by name, that only one of two learners has."""

    anew: list[str]
    """Those of the learner that takes weights over: they begin anew."""
    left: list[str]
    """Those of the saved one: they are left behind."""


def check_weights(saved: dict[str, Any], agent: Agent, losses: nn.ModuleDict) -> Unmatched:
    """Refuse what another learner saved, if the agent's networks are not in it.

    Args:
        saved: ``state_dict()`` of a learner.
        agent: The networks that are to load it.
        losses: Theirs; of networks that they have of their own, those that are there must be of the same shapes.

    Returns:
        The losses' own networks that only one of the two has.

    Raises:
        ValueError: If it is that of a model of another size or of another environment.
    """
    check_size(saved["size"], agent.size)
    parts = _networks(saved, agent)
    unmatched = Unmatched([], [])
    for name, loss in losses.items():
        kept = {key for key, _ in loss.named_buffers()}
        here = {key: value for key, value in own_state(loss, agent).items() if key not in kept}
        there = saved["losses"][name]
        ours, theirs = ({key.partition(".")[0] for key in state} for state in (here, there))
        networks = {key.partition(".")[0] for key in there if "." in key}  # the others may be what that loss kept
        unmatched.anew.extend(sorted(ours - theirs))
        unmatched.left.extend(sorted(networks - ours - {child for child, _ in loss.named_children()}))
        wanted = {key: value for key, value in here.items() if key.partition(".")[0] in theirs}
        parts[f"{name} loss"] = wanted, {key: there[key] for key in wanted if key in there}
    _check_parts(parts, saved, agent)
    return unmatched


def check_optimizers(saved: dict[str, Any], of_actor: bool) -> None:
    """Refuse the state of a learner whose actor learned by the other kind of optimiser.

    Args:
        saved: ``state_dict()`` of a learner.
        of_actor: Whether the one that is to load it has an optimiser for its actor alone.

    Raises:
        ValueError: If they differ.
    """
    if ("actor_optimizer" in saved) is not of_actor:
        there, here = ("none", "an optimiser of its own") if of_actor else ("an optimiser of its own", "none")
        raise ValueError(
            f"The checkpoint's actor learned with {there}, and this learner's has {here}: choose the loss.actor that "
            "it was trained with, or begin a run with its weights (init_from=)."
        )


def load_parameters(module: nn.Module, saved: Mapping[str, Tensor]) -> None:
    """Load the parameters of a module from a state, and leave its buffers alone."""
    own = dict(module.named_parameters())
    module.load_state_dict({name: value for name, value in saved.items() if name in own}, strict=False)


def check_size(checkpoint: dict[str, Any], size: ModelSize) -> None:
    """Refuse the state of a model of another size.

    Args:
        checkpoint: ``state_dict()["size"]`` of a learner.
        size: The size of the learner that loads it.

    Raises:
        ValueError: If they differ in anything but the name; the message says in what, and what to do.
    """
    wanted = asdict(size)
    checkpoint = {**{name: getattr(ModelSize, name) for name in VARIANTS}, **checkpoint}  # older ones do not say
    names = [field.name for field in fields(size) if field.name != "name"]
    other = [name for name in names if _plain(checkpoint.get(name)) != _plain(wanted[name])]
    if other:
        differences = "; ".join(f"{name} {checkpoint.get(name)} there, {wanted[name]} here" for name in other)
        variants = [f"model.{name}={str(checkpoint[name]).lower()}" for name in other if name in VARIANTS]
        start = " ".join([f"model={checkpoint.get('name')}", *variants])
        raise ValueError(
            f"The checkpoint holds a model of size {checkpoint.get('name')!r}, but this learner was made with size "
            f"{size.name!r} ({differences}). Weights cannot be converted between sizes: start with {start} to use this "
            f"checkpoint, or train size {size.name!r} from the beginning."
        )


def _plain(value: Any) -> Any:
    """Return tuples as lists, as files keep them."""
    return list(value) if isinstance(value, tuple) else value


Parts = dict[str, tuple[dict[str, Tensor], dict[str, Tensor]]]
"""What is wanted of a part of a learner, and what is found, by the part's name."""


def _networks(saved: dict[str, Any], agent: Agent) -> Parts:
    """Return the agent's part; where an older checkpoint does not say the deviation's bounds, with the agent's own."""
    bounds = {f"actor.{name}": agent.actor.get_buffer(name) for name in ("min_std", "max_std")}
    return {"networks": (agent.state_dict(), bounds | saved["agent"])}


def _check_parts(parts: Parts, saved: dict[str, Any], agent: Agent) -> None:
    """Refuse parts of other parameters than these."""
    # Older checkpoints do not say: their images were of the default size.
    there, here = saved.get("image_size", Interface.image_size), agent.interface.image_size
    where = (
        "in an environment of other observations or actions"
        if there == here
        else f"on images of {there} × {there} pixels, not {here} × {here}: choose env.image_size={there}"
    )
    for part, (wanted, found) in parts.items():
        lacking, surplus = sorted(wanted.keys() - found.keys()), sorted(found.keys() - wanted.keys())
        if lacking or surplus:
            raise ValueError(
                f"The checkpoint's {part} has {', '.join(surplus[:2]) or 'nothing'} beyond this learner's, and "
                f"lacks {', '.join(lacking[:2]) or 'nothing'}: it was trained with another loss, or in an "
                "environment of other observations. Choose those it was trained with."
            )
        for key, value in wanted.items():
            if value.shape != found[key].shape:
                raise ValueError(
                    f"The checkpoint's {part} has {key} of shape {list(found[key].shape)}, this learner's of "
                    f"{list(value.shape)}: it was trained {where}."
                )
