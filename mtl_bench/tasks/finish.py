"""From the network's outputs to what a car would use: panoptic ids, metric depth, 3D points.

One module for all: evaluation's functions (postprocess, depth_scale) in the order in which timings,
engines and exported graphs run them. torch.onnx.export takes it for a batch of one image.
Shapes: B images, H x W pixels, C classes.
"""

from torch import Tensor, nn

from mtl_bench.core import config
from mtl_bench.core.geometry import back_project, depth_from_inverse
from mtl_bench.tasks.panoptic import pixels
from mtl_bench.tasks.panoptic.postprocess import classes, dgc_scale, find_centers, group, member


class Finish(nn.Module):
    """Post-processing as a module; what a task that is not there would give is absent.

    Args:
        things: class indices whose pixels are grouped into instances.
        road: class index that the depth's scale is taken from.
        ev: settings of the grouping.
        pointless: class indices without points, such as the sky; None: no points at all.
    """

    def __init__(
        self,
        things: tuple[int, ...],
        road: int,
        ev: config.Evaluate,
        pointless: tuple[int, ...] | None = None,
    ) -> None:
        super().__init__()
        self.things, self.road, self.ev, self.pointless = things, road, ev, pointless

    def forward(
        self,
        semantic: Tensor | None = None,
        center_B1HW: Tensor | None = None,
        offset_B2HW: Tensor | None = None,
        inverse_B1HW: Tensor | None = None,
        K_B33: Tensor | None = None,
        camera_height_m_B: Tensor | None = None,
        pitch_rad_B: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Results of the tasks whose maps are given.

        Args:
            semantic: logits [B,C,H,W] or class indices [B,H,W]; with center and offset.
            inverse_B1HW: inverse depth; with K and the camera's height. Without `semantic` the
                scale comes from horizontal surfaces, and every pixel has a point.
            pitch_rad_B: calibrated, positive looks down; None = level.

        Returns:
            "panoptic" [B,H,W] int32 (postprocess.panoptic's ids); "depth_m" [B,1,H,W], NaN
            everywhere if the scale could not be found; "points" [B,3,H,W] in the camera's frame,
            metres, NaN where the class is in `pointless` or there is no depth.
        """
        result: dict[str, Tensor] = {}
        class_BHW = None
        if semantic is not None:
            assert center_B1HW is not None
            assert offset_B2HW is not None
            class_BHW = classes(semantic)
            centers_BK2, count_B = find_centers(center_B1HW, self.ev)
            result["panoptic"] = group(
                class_BHW, centers_BK2, count_B, offset_B2HW, self.things, self.ev.stuff_area
            )
        if inverse_B1HW is not None:
            assert K_B33 is not None
            assert camera_height_m_B is not None
            depth_B1HW = depth_from_inverse(inverse_B1HW.float())
            road_BHW = None if class_BHW is None else pixels.equal(class_BHW, self.road)
            scale_B, _ = dgc_scale(
                depth_B1HW, K_B33, camera_height_m_B, road_BHW, pitch_rad_B=pitch_rad_B
            )
            depth_m_B1HW = depth_B1HW.mul_(scale_B.view(-1, 1, 1, 1))
            result["depth_m"] = depth_m_B1HW
            if self.pointless is not None:
                if class_BHW is not None:
                    no_point_BHW = member(class_BHW, self.pointless)
                    depth_m_B1HW = depth_m_B1HW.masked_fill(no_point_BHW[:, None], 0)
                result["points"] = back_project(depth_m_B1HW, K_B33)
        return result
