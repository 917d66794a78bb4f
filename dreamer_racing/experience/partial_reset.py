"""Partial resets of many transformed worlds with images, without touching the images of the worlds that fly on."""

from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

IMAGES = "pixels"


class TransformedPixelEnv(TransformedEnv):
    """A ``TransformedEnv`` that after a partial reset copies the new images into their rows.

    TorchRL chooses between old and new with ``torch.where``, byte by byte: a tenth of the time of a step of 256 worlds.
    """

    def _reset_proc_data(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        reset = None if tensordict is None else tensordict.get("_reset", None)
        old = None if tensordict is None else tensordict.get(IMAGES, None)
        new = tensordict_reset.get(IMAGES, None)
        if tensordict is None or reset is None or old is None or new is None:
            return super()._reset_proc_data(tensordict, tensordict_reset)
        mask = reset.reshape(tensordict.batch_size)
        images = old.clone()  # the step before keeps them as its outcome
        images[mask] = new[mask]
        del tensordict[IMAGES], tensordict_reset[IMAGES]
        return super()._reset_proc_data(tensordict, tensordict_reset).set(IMAGES, images)
