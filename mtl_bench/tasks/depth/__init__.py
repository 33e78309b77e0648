"""Depth from one image, learned without labels from how neighbouring frames rebuild each other.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021) after Monodepth2 (Godard et al., ICCV 2019):
inverse depth at several scales, a pose network in training, and metres from the camera's height.
Errors are reported by protocols, and twice: `depth_median` scales each image by the ratio of
medians (it looks at the truth), `depth_dgc` by the camera's height above the ground.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.columns import Column
from mtl_bench.core.dataset import NEIGHBOURS, Dataset
from mtl_bench.core.geometry import back_project, depth_from_inverse
from mtl_bench.core.labels import GROUND, NO_SURFACE, LabelSet
from mtl_bench.core.recipe import Evaluate, Network
from mtl_bench.core.task import Frame, MapInfo, Maps, Metric, Results, Size, Task, TaskHead, Trivial
from mtl_bench.core.terms import Term
from mtl_bench.core.view import METRES, STEPS
from mtl_bench.data import npy, png
from mtl_bench.model.layers import Decoder, Head, full
from mtl_bench.tasks import pixels
from mtl_bench.tasks.depth import protocols
from mtl_bench.tasks.depth.losses import photometric_loss, smoothness_loss
from mtl_bench.tasks.depth.metrics import DepthErrors, evaluation_mask, median_scale
from mtl_bench.tasks.depth.picture import HEIGHTS, UNSCALED, DepthView
from mtl_bench.tasks.depth.pose import PoseNetwork
from mtl_bench.tasks.depth.protocols import Protocol
from mtl_bench.tasks.depth.scale import DGC_SOURCES, FAILED, NORMALS, ROAD, dgc_scale

FLIP = "inverse depth is the mean with that of the mirrored image, mirrored back"


class DepthHead(TaskHead):
    """Raw maps: "inverse" logits at the finest stride; auxiliary "inverse.1", "inverse.2"."""

    def __init__(self, inputs: tuple[int, ...], sizes: Network) -> None:
        super().__init__()
        self.decoders = nn.ModuleDict({"depth": Decoder(inputs, sizes.channels, sizes.fused)})
        widths = (sizes.fused, sizes.channels, sizes.channels)
        heads = nn.ModuleList(Head(width, sizes.head, 1) for width in widths)
        self.heads = nn.ModuleDict({"depth": heads})

    def forward(
        self, pyramid: Sequence[Tensor], context_BC11: Tensor, auxiliary: bool = False
    ) -> Maps:
        features = self.decoders["depth"](pyramid, context_BC11)
        heads = list(self.heads["depth"])[: None if auxiliary else 1]  # type: ignore[call-overload]
        return {_map(scale): head(features[scale]) for scale, head in enumerate(heads)}


def _map(scale: int) -> str:
    """Name of the map of a scale, 0 = finest."""
    return f"inverse.{scale}" if scale else "inverse"


def _rows(map_: Tensor) -> Tensor:
    """[h,1]: the middles of a map's rows, -1/2 at the image's upper edge, 1/2 at its lower one."""
    height = map_.shape[-2]
    rows = torch.arange(height, device=map_.device) + 0.5
    return (rows / height - 0.5).to(map_.dtype)[:, None]


class Depth(Task):
    terms = (
        Term("photometric", "depth", "regression", 1.0),
        Term("smoothness", "depth", "regression", 0.001),
    )
    kind = "regression"
    needs = frozenset({NEIGHBOURS})
    truth = frozenset({"depth_m"})
    after = ("panoptic",)  # the ground, which the scale is taken from
    averages_flip = True
    maps: ClassVar[Mapping[str, MapInfo]] = {"inverse": MapInfo("inverse_depth", quantity="depth")}
    exported = ("depth_m", "depth", "scale")
    meaning: ClassVar[Mapping[str, str]] = {
        "inverse_depth": "1 / depth along the optical axis, without scale",
        "depth_m": "along the optical axis in the unit of camera_height_m: scale * depth; NaN "
        "everywhere where no ground was found. Classes without a surface have values, too",
        "depth": "along the optical axis, without scale: what is left where no ground was found",
        "scale": "from depth to depth_m, from the camera's height above the ground; NaN: no ground",
        "points": "in the camera's frame: x right, y down, z forward, in the unit of "
        "camera_height_m; NaN where no ground was found or the class has no surface",
    }
    has_points = True
    reads_camera = True
    columns = (
        Column(
            *("abs_rel", "depth_median.abs_rel", "AbsRel", -1, 3),
            note="median-scaled",
            in_delta=True,
            short=True,
        ),
        Column(
            *("rmse", "depth_median.rmse", "RMSE", -1, 2, "m"),
            note="median-scaled",
            in_delta=True,
            headline=True,
            words="depth error",
        ),
        Column(
            *("delta1", "depth_median.delta1", "delta1", +1, 3),
            note="median-scaled",
            in_delta=True,
            tex=r"$\delta_1$",
        ),
        Column(
            *("rmse_dgc", "depth_dgc.rmse", "RMSE dgc", -1, 2, "m"), note="dgc-scaled", short=True
        ),
    )
    files = ("depth", "points")
    scored = ("_depth.png", "_depth.npy", ".png", ".npy")
    drawn: ClassVar[Mapping[str, str]] = {
        "depth_m": "depth (median-scaled, 2 m bright to 80 m dark, gray without value)",
    }
    agreement = (
        Column(
            *("depth_rel", "agreement.depth_median_rel", "depth", -1, 0, "median diff."),
            scientific=True,
            words="depth relative",
        ),
    )
    counts: ClassVar[Mapping[str, str]] = {
        "dgc.failed": "no scale found",
        "dgc.fallback": "scale from surface normals",
    }
    words: ClassVar[Mapping[str, str]] = {
        "trivial": "mean depth image",
        "trivial_note": "Its depth is in metres already, so nothing scales it under dgc.",
        "timed": "metric depth",
        "counted": "Images whose depth was not scaled from the road",
    }

    # --- network ----------------------------------------------------------------------------------

    def head(self, inputs: tuple[int, ...], sizes: Network) -> DepthHead:
        return DepthHead(inputs, sizes)

    def activate(self, maps: Maps) -> Maps:
        """Inverse depth, of an arbitrary unit, at most 1 / min_depth.

        With a slope, training starts from a ground that comes nearer towards the image's bottom. A
        wall is as far from the world as from the world upside down, and some networks learn that.
        """
        least, slope = self.recipe.network.min_depth, self.recipe.network.depth_slope
        if slope:
            maps = {name: map_ + slope * _rows(map_) for name, map_ in maps.items()}
        return {name: map_.sigmoid() / least for name, map_ in maps.items()}

    def extra(self, sizes: Network, pretrained: bool) -> dict[str, nn.Module]:
        return {"pose": PoseNetwork(sizes.pose, sizes.pose_channels, sizes.pose_scale, pretrained)}

    # --- training ---------------------------------------------------------------------------------

    def begin(self, dataset: Dataset) -> None:
        """Unmasked skies do not move: `automask` then keeps them from pulling on the depth."""
        loss = self.recipe.loss
        automask = loss.automask or not dataset.knows_static
        self.recipe = replace(self.recipe, loss=replace(loss, automask=automask))

    def training_maps(self, extra: Mapping[str, nn.Module], batch: Batch) -> Maps:
        if "neighbours" not in batch.fields:
            return {}
        return {"transforms": extra["pose"](batch.image_B3HW, batch.fields["neighbours"])}

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        loss, fields = self.recipe.loss, batch.fields
        if "clean_neighbours" not in fields:
            return {}
        available = sum(name.partition(".")[0] == "inverse" for name in maps)
        if not loss.scales or not all(0 <= scale < available for scale in loss.scales):
            raise ValueError(
                f"recipe.loss.scales = {list(loss.scales)}, but the network has the depth outputs "
                f"{list(range(available))}: name one or more of those"
            )
        inverse_SB1HW = [full(maps[_map(scale)]) for scale in loss.scales]
        clean_B3HW, mask_BHW = full(fields["clean"]), fields["reprojection_mask"]
        assert batch.camera is not None
        photometric = photometric_loss(
            clean_B3HW,
            full(fields["clean_neighbours"]),
            inverse_SB1HW,
            full(batch.camera.K_B33),
            mask_BHW,
            full(maps["transforms"]),
            ssim_weight=loss.ssim_weight,
            automask=loss.automask,
            hints=loss.hints,
        )
        if photometric is None:  # smoothness alone, which only regularises it, wants a flat world
            return {}
        smoothness = smoothness_loss(inverse_SB1HW, loss.scales, clean_B3HW, mask_BHW)
        return {"photometric": photometric, "smoothness": smoothness}

    def training_protocol(self, dataset: Dataset) -> dict[str, Any]:
        """What kept the sky and the ego vehicle out of the photometric loss."""
        return {"reprojection_mask": dataset.static_from}

    # --- results ----------------------------------------------------------------------------------

    def flip_averaged(self, maps: Maps, mirrored: Maps) -> Maps:
        """The finest inverse depth averaged with that of the mirrored image."""
        return {"inverse": (maps["inverse"] + mirrored["inverse"].flip(-1)) / 2}

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        """The scale is found at the network's input size, depth given at the size asked for.

        Returns:
            "depth" [B,1,H,W] without scale; "scale" [B] to metres, NaN where none was found;
            "source" [B], an index into DGC_SOURCES; "depth_m" [B,1,H,W], their product.
        """
        depth_B1HW = depth_from_inverse(maps["inverse"].float())
        ground_BHW = None
        classes = _classes(done, "seen_class")
        if classes is not None:
            ground_BHW = pixels.member(classes, self.labels.of_role(GROUND))
        scale_B, source_B = dgc_scale(
            depth_B1HW, camera.K_B33, camera.height_m_B, ground_BHW, pitch_rad_B=camera.pitch_rad_B
        )
        if size not in (None, tuple(depth_B1HW.shape[2:])):
            maps = self.resized({"inverse": maps["inverse"]}, size)
            depth_B1HW = depth_from_inverse(maps["inverse"].float())
        depth_m_B1HW = depth_B1HW * scale_B[:, None, None, None]
        return {"depth": depth_B1HW, "scale": scale_B, "source": source_B, "depth_m": depth_m_B1HW}

    def points(self, results: Mapping[str, Results], camera: Camera) -> Tensor:
        """NaN also where the class has no surface, such as the sky."""
        depth_m_B1HW = results[self.name]["depth_m"]
        classes = _classes(results, "class")
        if classes is not None:
            nothing_BHW = pixels.member(classes, self.labels.of_role(NO_SURFACE))
            depth_m_B1HW = depth_m_B1HW.masked_fill(nothing_BHW[:, None], 0)
        return back_project(depth_m_B1HW, camera.K_B33)

    def metrics(self, split: str | None = None) -> list[Metric]:
        chosen = protocols.of_recipe(self.recipe, split)
        return [
            DepthMetric(protocol, f"{protocol.name}." * (protocol is not chosen[0]))
            for protocol in chosen
        ]

    def protocol(self, tasks: Collection[str]) -> dict[str, Any]:
        main = protocols.of_recipe(self.recipe)[0]
        return {
            "depth_source": main.source,
            "depth_truth": main.truth,
            "depth_range_m": [main.min_depth_m, main.max_depth_m],
            "depth_crop": main.depth_crop,
            "depth_scalings": list(main.scalings),
            "depth_pixels": "where the truth has a value; predicted sky and ego vehicle count",
            "depth_mean": "over images; those whose dgc failed are counted, not averaged",
            "depth_flip": FLIP if self.recipe.evaluate.flip else "none",
            "dgc_ground": "predicted road" if set(self.after) & set(tasks) else "normals",
        }

    def read_result(self, path: Path, size: Size) -> Results:
        """Metres, in .npy or in 1/256 as a PNG of 16 bits; as they are where dgc would scale them.

        Pixels without a value take the nearest one's, as KITTI's evaluator fills them.
        """
        depth_HW = npy.read(path) if path.suffix == ".npy" else png.read(path, 16) / STEPS
        known_HW = np.isfinite(depth_HW) & (depth_HW > 0)
        if depth_HW.ndim != 2 or not known_HW.any():
            raise ValueError(f"{path}: no depth of a pixel in it, or not one map [H,W]")
        depth_HW = pixels.filled(depth_HW.astype(np.float32), known_HW)
        inverse = {"inverse": torch.from_numpy(1 / depth_HW)[None, None]}
        if depth_HW.shape != size:
            inverse = self.resized(inverse, size)
        depth_B1HW = depth_from_inverse(inverse["inverse"])
        ones, road = torch.ones(1), torch.full((1,), ROAD)
        return {"depth": depth_B1HW, "scale": ones, "source": road, "depth_m": depth_B1HW}

    def trivial(self, size: Size) -> Trivial:
        return MeanDepth(self.recipe.evaluate, size)

    # --- for a viewer -----------------------------------------------------------------------------

    def view_of(self, results: Mapping[str, Results], camera_height_m: float | None) -> DepthView:
        """In the network's unit where no scale was found; 0 where the class has no surface."""
        found = {name: value[0].cpu() for name, value in results[self.name].items()}
        depth_HW, source = found["depth"][0].numpy(), int(found["source"])
        unit, height = UNSCALED, None
        if source != FAILED:
            unit, height = METRES if camera_height_m else HEIGHTS, camera_height_m or 1.0
            depth_HW = depth_HW * np.float32(found["scale"].item())
        classes = _classes(results, "class")
        if classes is not None:
            nothing = self.labels.of_role(NO_SURFACE)
            depth_HW = depth_HW * ~np.isin(classes[0].cpu().numpy(), nothing)
        return DepthView(depth_HW, unit, DGC_SOURCES[source], height)

    @classmethod
    def drawn_view(cls, name: str, map_HW: NDArray[Any], labels: LabelSet) -> DepthView:
        return DepthView(np.asarray(map_HW, np.float32), METRES)


def _classes(results: Mapping[str, Results], key: str) -> Tensor | None:
    """The class map of whichever task has one."""
    return next((found[key] for found in results.values() if key in found), None)


class DepthMetric(Metric):
    """The depth errors of one protocol over its frames."""

    def __init__(self, protocol: Protocol, prefix: str = "") -> None:
        self.protocol, self.prefix = protocol, prefix
        self.split, self.truth = protocol.split, protocol.truth
        self.reads_others = "dgc" in protocol.scalings
        self.errors = {scaling: DepthErrors(protocol) for scaling in protocol.scalings}
        self.sources = np.zeros(len(DGC_SOURCES), np.int64)
        self.scale_ratios: list[float] = []  # dgc over median
        self.frames = 0
        self.sizes: dict[Size, None] = {}  # of the truth, in the order of their appearance
        self.ground = ""

    def update(self, truth: Frame, result: Frame) -> Frame:
        depth_HW, true_m_HW = result["depth"][0], truth["depth_m"]
        self.frames += 1
        self.sizes[true_m_HW.shape[0], true_m_HW.shape[1]] = None
        mask_HW = evaluation_mask(true_m_HW, self.protocol)
        ratio = median_scale(depth_HW, true_m_HW, mask_HW) if mask_HW.any() else 1.0
        self.errors["median"].update(depth_HW * ratio, true_m_HW)
        if "dgc" in self.errors:
            dgc, source = float(result["scale"]), int(result["source"])
            self.sources[source] += 1
            if source != FAILED:
                self.errors["dgc"].update(depth_HW * dgc, true_m_HW)
                if mask_HW.any():
                    self.scale_ratios.append(dgc / ratio)
        shown_m_HW = (depth_HW * ratio).clip(0, self.protocol.max_depth_m).astype(np.float16)
        return {"depth_m": shown_m_HW, "true_depth_m": true_m_HW}

    def state(self) -> dict[str, NDArray[Any]]:
        found = {f"errors.{key}": errors.state() for key, errors in self.errors.items()}
        return {
            **found,
            "sources": self.sources,
            "ratios": np.array(self.scale_ratios),
            "frames": np.array(self.frames),
            "sizes": np.array(list(self.sizes), np.int64).reshape(-1, 2),
        }

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        for key, errors in self.errors.items():
            errors.add(state[f"errors.{key}"])
        self.sources += state["sources"]
        self.scale_ratios += state["ratios"].tolist()
        self.frames += int(state["frames"])
        self.sizes |= dict.fromkeys((height, width) for height, width in state["sizes"].tolist())

    def compute(self) -> dict[str, float]:
        metrics: dict[str, float] = {}
        for scaling, errors in self.errors.items():
            found = {f"depth_{scaling}.{key}": v for key, v in errors.compute().items()}
            metrics |= {key: value for key, value in found.items() if not np.isnan(value)}
        metrics["depth.without_truth"] = self.errors["median"].without_truth
        if "dgc" in self.errors:
            metrics["dgc.failed"] = int(self.sources[FAILED])
            metrics["dgc.fallback"] = int(self.sources[NORMALS])
            if self.scale_ratios:
                metrics["dgc.to_median"] = float(np.mean(self.scale_ratios))
                metrics["dgc.to_median_sd"] = float(np.std(self.scale_ratios))
        return {f"{self.prefix}{key}": value for key, value in metrics.items()}

    def record(self) -> dict[str, Any]:
        sizes = [list(size) for size in self.sizes]
        compared = sizes[0] if len(sizes) == 1 else sizes
        return {**self.protocol.record(), "frames": self.frames, "compared_at": compared}


class MeanDepth(Trivial):
    """The mean depth of each pixel, which is in metres already: nothing scales it under dgc."""

    protocol: Mapping[str, Any] = {"dgc_ground": "none: the mean depth is in metres"}

    def __init__(self, ev: Evaluate, size: Size) -> None:
        self.ev = replace(ev, depth_crop="none")
        self.depth_sum, self.depth_count = np.zeros(size), np.zeros(size, np.int32)

    def add(self, truth: Frame) -> None:
        depth_m = pixels.sampled(truth["depth_m"], self.depth_sum.shape)
        valid_HW = evaluation_mask(depth_m, self.ev)
        self.depth_sum += np.where(valid_HW, depth_m, 0)
        self.depth_count += valid_HW

    def depth_m_HW(self) -> NDArray[np.float32]:
        """Where no depth was ever valid, the nearest pixel's that has one."""
        if not self.depth_count.any():
            raise ValueError("no frame of the training split has a valid depth")
        mean_HW = self.depth_sum / np.maximum(self.depth_count, 1)
        return pixels.filled(mean_HW, self.depth_count > 0).astype(np.float32)

    def result(self, count: int, size: Size) -> Results:
        depth_m_HW = torch.from_numpy(pixels.sampled(self.depth_m_HW(), size))
        depth_B1HW = depth_m_HW.expand(count, 1, -1, -1)
        ones, road = torch.ones(count), torch.full((count,), ROAD)
        return {"depth": depth_B1HW, "scale": ones, "source": road, "depth_m": depth_B1HW}
