"""Posed photos of one scene with their masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.camera import Camera
from pigjax.core.errors import InputError


class Views(eqx.Module):
    """Posed photos of one scene, all of one size.

    Pictures and masks stay in host memory as NumPy arrays until someone computes with them.
    """

    cameras: Camera  # batch of t
    names: tuple[str, ...] = eqx.field(static=True)  # file names without suffix; with it or folders if they repeat
    images: Float[np.ndarray | Array, "t h w 3"]  # RGB in 0..1
    masks: Int[np.ndarray | Array, "t h w"] | None  # object ids; -1 all over in views without a mask, which do not vote
    splits: tuple[str, ...] = eqx.field(static=True)  # "train", "test", ...
    points_path: Path | None = eqx.field(static=True, default=None)  # sparse cloud for `load_points`
    # pixels that the photos have and that are not to be ignored: others are never fitted, scored or counted in a vote.
    # None: all
    valid: Bool[np.ndarray | Array, "t h w"] | None = None

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int | slice | Sequence[int] | np.ndarray) -> Views:
        """The chosen views, in that order; one index gives `Views` of length 1."""
        chosen = np.atleast_1d(np.arange(len(self))[index])
        return Views(
            cameras=self.cameras[chosen],
            names=tuple(self.names[i] for i in chosen),
            images=self.images[chosen],
            masks=None if self.masks is None else self.masks[chosen],
            splits=tuple(self.splits[i] for i in chosen),
            points_path=self.points_path,
            valid=None if self.valid is None else self.valid[chosen],
        )

    def subset(self, split: str) -> Views:
        """Views of one split.

        Raises:
            InputError: no view belongs to it.
        """
        return self[of_split(self.splits, split, "Views")]

    @property
    def training(self) -> Views:
        """Views of the split "train"; all views where there is none."""
        return self.subset("train") if "train" in self.splits else self

    @property
    def masked(self) -> Views:
        """Views that have a mask; the others do not vote, nor is an object fitted to them.

        Raises:
            InputError: no view has one.
        """
        has_mask = np.zeros(len(self), bool) if self.masks is None else np.asarray(self.masks)[:, 0, 0] >= 0
        if not has_mask.any():
            raise InputError(
                f"Views: none of {len(self)} views has a mask; load them with load_views(..., masks=True)."
            )
        return self if has_mask.all() else self[np.flatnonzero(has_mask)]

    @property
    def voters(self) -> Views:
        """Training views with a mask; where no training view has one, all views with a mask.

        Raises:
            InputError: no view has one.
        """
        masked = self.masked
        return masked.training if "train" in masked.splits else masked

    @property
    def held_out(self) -> Views | None:
        """Views of the split "test"; None where there is none."""
        return self.subset("test") if "test" in self.splits else None


def of_split(splits: Sequence[str], split: str, where: str) -> list[int]:
    """Numbers of the views of a split.

    Raises:
        InputError: no view is of that split; it names those that there are.
    """
    found = [i for i, name in enumerate(splits) if name == split]
    if not found:
        counts = ", ".join(f"{name} ({splits.count(name)})" for name in sorted(set(splits)))
        raise InputError(f"{where}: no views in split {split!r}; choose one of {counts}.")
    return found
