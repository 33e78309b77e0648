"""Depth protocols by name: which frames and pixels, against what truth, and how scaled.

Published depth errors differ by these as much as by the networks, and tables have mixed them: a row
says which it was measured by. The range is 0.001 to 80 m in all of them, errors are means over
images, and predictions are compared at the truth's own size, clamped to the range after scaling.
"""

from dataclasses import dataclass, replace
from typing import Any

from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.plain import did_you_mean
from mtl_bench.core.recipe import Recipe
from mtl_bench.tasks.depth.metrics import CROPS


@dataclass(frozen=True)
class Protocol:
    """How depth is measured; `metrics` reads the range and the crop."""

    name: str
    split: str
    truth: str  # disparity | improved | velodyne, one of the data set's
    depth_crop: str  # a key of `metrics.CROPS`
    scalings: tuple[str, ...]  # median looks at the truth, dgc at the camera's height
    frames_published: int  # of the split, as papers report it
    source: str
    min_depth_m: float = 0.001
    max_depth_m: float = 80.0
    changed: tuple[str, ...] = ()  # fields that are not as published

    @property
    def title(self) -> str:
        """The name, and what is not as published: "full-frame (split train)"."""
        words = ", ".join(f"{key} {getattr(self, key)}" for key in self.changed)
        return f"{self.name} ({words})" if words else self.name

    def record(self) -> dict[str, object]:
        """What a row keeps of it."""
        return {
            "name": self.title,
            "split": self.split,
            "truth": self.truth,
            "published_frames": self.frames_published,
            "depth_range_m": [self.min_depth_m, self.max_depth_m],
            "depth_crop": self.depth_crop,
            "depth_scalings": list(self.scalings),
            "source": self.source,
        }


_BOTH = ("median", "dgc")
NAMED = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            *("full-frame", "val", "disparity", "none", _BOTH, 500),
            source="MGNet (Schoen et al., ICCV 2021): Cityscapes' whole frame, stereo disparity",
        ),
        Protocol(
            *("manydepth-crop", "test", "disparity", "manydepth", ("median",), 1525),
            source="ManyDepth (Watson et al., CVPR 2021): its crop of Cityscapes, of which its "
            "network is shown no lower quarter",
        ),
        Protocol(
            *("eigen-improved", "test", "improved", "none", _BOTH, 652),
            source="Eigen's test frames with KITTI's improved depth maps (Uhrig et al., 3DV 2017)",
        ),
        Protocol(
            *("eigen-improved-crop", "test", "improved", "garg", _BOTH, 652),
            source="the same in Garg's crop: MGNet's public code, with dgc",
        ),
        Protocol(
            *("eigen-raw", "test", "velodyne", "garg", ("median",), 697),
            source="Eigen et al., NeurIPS 2014: raw laser points, in the crop of Garg et al., "
            "ECCV 2016",
        ),
    )
}


def named(name: str, recipe: Recipe) -> Protocol:
    """The protocol of that name.

    Raises:
        ValueError: no such protocol, or one whose truth the recipe's data set does not have.
    """
    if name not in NAMED:
        raise ValueError(f"no protocol called '{name}'{did_you_mean(name, NAMED)}")
    has = dataset_of(recipe).truths
    if has and NAMED[name].truth not in has:
        fitting = [protocol.name for protocol in NAMED.values() if protocol.truth in has]
        raise ValueError(
            f"protocol '{name}' needs {NAMED[name].truth} maps, which {recipe.data.dataset} lacks; "
            f"set recipe.evaluate.protocol or also to one of {', '.join(fitting)}"
        )
    return NAMED[name]


def of_recipe(recipe: Recipe, split: str | None = None) -> tuple[Protocol, ...]:
    """The main protocol and those that are measured also.

    The recipe's own split, range and crop stand in place of the main protocol's, which then says so
    in its title.

    Args:
        split: in place of every protocol's.

    Raises:
        ValueError: as `named`, a crop that is none, or a protocol that is asked for twice.
    """
    ev = recipe.evaluate
    if len({ev.protocol, *ev.also}) <= len(ev.also):
        raise ValueError(
            f"recipe.evaluate.also = {list(ev.also)} has a protocol twice, or the main one, "
            f"'{ev.protocol}'; name each once"
        )
    if ev.depth_crop not in CROPS:
        known = did_you_mean(ev.depth_crop, CROPS)
        raise ValueError(f"no recipe.evaluate.depth_crop called '{ev.depth_crop}'{known}")
    main = named(ev.protocol, recipe)
    others = [named(name, recipe) for name in ev.also]
    own = {"min_depth_m": ev.min_depth_m, "max_depth_m": ev.max_depth_m}
    crop = main.depth_crop if ev.depth_crop == "none" else ev.depth_crop
    return (
        _changed(main, split=split or ev.split, depth_crop=crop, **own),
        *(_changed(other, split=split or other.split) for other in others),
    )


def _changed(protocol: Protocol, **values: Any) -> Protocol:
    """With other values, and note of those that differ."""
    changed = tuple(key for key, value in values.items() if getattr(protocol, key) != value)
    return replace(protocol, **values, changed=changed)
