"""From the network's outputs to what a car would use: panoptic ids, metric depth, 3D points.

One module, so that one graph holds it: torch.onnx.export takes it for a batch of one image.
Shapes: H x W pixels, C classes.
"""

from torch import Tensor, nn

from mtl_bench import config
from mtl_bench.geometry import depth_from_inverse
from mtl_bench.postprocess import back_project, classes, dgc_scale, find_centers, group, member


class Finish(nn.Module):
    """Post-processing as a module; what a task that is not there would give is None.

    Args:
        things: class indices whose pixels are grouped into instances.
        road: class index that the depth's scale is taken from.
        ego_and_sky: class indices without points.
        ev: settings of the grouping.
    """

    def __init__(
        self, things: tuple[int, ...], road: int, ego_and_sky: tuple[int, ...], ev: config.Evaluate
    ) -> None:
        super().__init__()
        self.things, self.road, self.ego_and_sky, self.ev = things, road, ego_and_sky, ev

    def forward(
        self,
        semantic: Tensor | None = None,
        center_11HW: Tensor | None = None,
        offset_12HW: Tensor | None = None,
        inverse_11HW: Tensor | None = None,
        K_133: Tensor | None = None,
        camera_height_m_1: Tensor | None = None,
        pitch_rad_1: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Results of the tasks whose maps are given.

        Args:
            semantic: logits [1,C,H,W] or class indices [1,H,W]; with center and offset.
            inverse_11HW: inverse depth; with K and the camera's height. Without `semantic` the
                scale comes from horizontal surfaces, and every pixel has a point.
            pitch_rad_1: calibrated, positive looks down; None = level.

        Returns:
            "panoptic" [1,H,W] int32 (postprocess.panoptic's ids); "depth_m" [1,1,H,W], NaN
            everywhere if the scale could not be found; "points" [1,3,H,W] in the camera's frame,
            metres, NaN where the class is in `ego_and_sky` or there is no depth.
        """
        result: dict[str, Tensor] = {}
        class_1HW = None
        if semantic is not None:
            assert center_11HW is not None
            assert offset_12HW is not None
            class_1HW = classes(semantic)
            centers_1K2, count_1 = find_centers(center_11HW, self.ev)
            result["panoptic"] = group(
                class_1HW, centers_1K2, count_1, offset_12HW, self.things, self.ev.stuff_area
            )
        if inverse_11HW is not None:
            assert K_133 is not None
            assert camera_height_m_1 is not None
            depth_11HW = depth_from_inverse(inverse_11HW.float())
            road_1HW = None if class_1HW is None else class_1HW == self.road
            scale_1, _ = dgc_scale(
                depth_11HW, K_133, camera_height_m_1, road_1HW, pitch_rad_B=pitch_rad_1
            )
            depth_m_11HW = depth_11HW * scale_1.view(-1, 1, 1, 1)
            result["depth_m"] = depth_m_11HW
            if class_1HW is not None:
                no_point_1HW = member(class_1HW, self.ego_and_sky)
                depth_m_11HW = depth_m_11HW.masked_fill(no_point_1HW[:, None], 0)
            result["points"] = back_project(depth_m_11HW, K_133)
        return result
