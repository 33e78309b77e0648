"""Surface normals, learned from the normals of true depth.

Source: Eigen and Fergus, ICCV 2015: one minus the cosine to the true normal, where there is one.
Here the truth is the cross product of neighbouring points of the depth map.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from mtl_bench.core.columns import Column
from mtl_bench.core.geometry import back_project
from mtl_bench.core.task import MapInfo, Metric, Task
from mtl_bench.core.terms import Term
from mtl_bench.model.layers import DenseHead


class Slopes(Task):
    terms = (Term("angle", "slopes", "regression", 1.0),)
    needs = truth = frozenset({"depth_m"})
    maps = {"slopes": MapInfo("slopes")}
    exported = ("slopes",)
    columns = (
        Column(
            *("mean_angle", "slopes.mean_angle", "mean angle", -1, 1, "deg"),
            in_delta=True,
            headline=True,
            words="angular error",
        ),
        Column("slope_30", "slopes.within_30", "< 30 deg", +1, 3),
    )

    def head(self, inputs, sizes):
        return DenseHead("slopes", inputs, sizes, 3)

    def targets(self, sample):
        return {"slopes": normals_of(sample.fields["depth_m"][None], sample.camera.K_B33[None])[0]}

    def losses(self, maps, batch):
        cosine_N = cosine(maps["slopes"].float(), batch.fields["slopes"])
        return {"angle": (1 - cosine_N).mean()} if len(cosine_N) else {}

    def finish(self, maps, camera, done, size=None):
        if size not in (None, tuple(maps["slopes"].shape[2:])):
            maps = self.resized(maps, size)
        count = len(maps["slopes"])
        return {
            "slopes": F.normalize(maps["slopes"].float(), dim=1),
            "K": camera.K_B33.expand(count, 3, 3),
        }

    def metrics(self, split=None):
        metric = MeanAngle()
        metric.split = split or self.recipe.evaluate.split
        return [metric]


class MeanAngle(Metric):
    """Mean over pixels of the angle to the true normal, degrees; share of pixels below 30."""

    def __init__(self):
        self.sums = torch.zeros(3, dtype=torch.float64)  # degrees, pixels below 30, pixels

    def update(self, truth, result):
        depth_HW, found_3HW = torch.as_tensor(truth["depth_m"]), torch.as_tensor(result["slopes"])
        true_3HW = normals_of(depth_HW[None], torch.as_tensor(result["K"])[None])[0]
        valid_HW = true_3HW.square().sum(0) > 0.5
        angle_N = torch.rad2deg((true_3HW * found_3HW).sum(0)[valid_HW].clamp(-1, 1).acos())
        self.sums += torch.stack([angle_N.sum(), (angle_N < 30).sum(), valid_HW.sum()]).double()
        return {}

    def state(self):
        return {"sums": self.sums.numpy()}

    def add(self, state):
        self.sums += torch.as_tensor(state["sums"])

    def compute(self):
        degrees, below, pixels = self.sums.tolist()
        if not pixels:
            return {}
        return {"slopes.mean_angle": degrees / pixels, "slopes.within_30": below / pixels}


def normals_of(depth_BHW: Tensor, K_B33: Tensor) -> Tensor:
    """Unit normals [B,3,H,W] towards the camera; zero where a neighbour has no depth."""
    points_B3HW = back_project(depth_BHW[:, None], K_B33)
    right = points_B3HW[..., :-1, 1:] - points_B3HW[..., :-1, :-1]
    down = points_B3HW[..., 1:, :-1] - points_B3HW[..., :-1, :-1]
    found = F.normalize(torch.linalg.cross(down, right, dim=1), dim=1)
    return F.pad(found, (0, 1, 0, 1)).nan_to_num(0.0)


def cosine(found_B3HW: Tensor, true_B3HW: Tensor) -> Tensor:
    """[N], of the pixels that have a true normal."""
    valid_BHW = true_B3HW.square().sum(1) > 0.5
    cosine_BHW = (F.normalize(found_B3HW, dim=1) * true_B3HW).sum(1)
    return cosine_BHW[valid_BHW]
