"""A Rerun recording (.rrd): image, segments, depth and points of every frame, to scroll through."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from mtl_bench.core.files import utf8_name
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.view import METRES, Surface
from mtl_bench.show.predict import Predicted
from mtl_bench.show.predict.point_cloud import from_prediction

MOST_POINTS = 50_000  # a frame: of a video's 200 frames all points would be gigabytes


def missing() -> str | None:
    """Why there can be no recording, and the remedy; None where there can."""
    if importlib.util.find_spec("rerun") is None:
        return "--rerun needs the package rerun-sdk: pip install 'mtl-bench[rerun]'"
    return None


class Recording:
    """An open recording; frames go to the file as they come.

    Args:
        path: of the file, which is overwritten.
    """

    def __init__(self, path: Path, labels: LabelSet) -> None:
        import rerun

        self._rerun, self.labels = rerun, labels
        self._stream = rerun.RecordingStream("mtl-bench")
        self._stream.save(utf8_name(path, "Rerun"))
        self._stream.log("world", rerun.ViewCoordinates.RDF, static=True)
        classes = [(label.label_id, label.name, label.color) for label in labels.labels]
        self._stream.log("world", rerun.AnnotationContext(classes), static=True)

    def add(self, number: int, name: str, predicted: Predicted) -> None:
        """Log a frame under `world/camera` and `world/points`."""
        rerun, stream = self._rerun, self._stream
        height, width = predicted.image_HW3.shape[:2]
        stream.set_time("frame", sequence=number)
        stream.log("name", rerun.TextLog(name))
        camera: Any = rerun.Pinhole(
            image_from_camera=predicted.K_33,
            width=width,
            height=height,
            camera_xyz=rerun.ViewCoordinates.RDF,
        )
        stream.log("world/camera", camera)
        stream.log("world/camera/image", rerun.Image(predicted.image_HW3).compress())
        for view in predicted.views:
            place = f"world/camera/{view.task}"
            if isinstance(view, Surface):
                metre = 1.0 if view.unit == METRES else None
                depth_HW = view.depth_HW.astype(np.float32)
                stream.log(place, rerun.DepthImage(depth_HW, meter=metre))
            else:
                stream.log(place, rerun.Image(view.picture(predicted.image_HW3)).compress())
        if predicted.surface is not None:
            cloud = from_prediction(predicted, self.labels)
            step = 1 + len(cloud) // MOST_POINTS
            points = rerun.Points3D(
                cloud.points_N3[::step],
                colors=cloud.colors_N3[::step],
                class_ids=cloud.class_N[::step].astype(np.uint16),
            )
            stream.log("world/points", points)

    def close(self) -> None:
        self._stream.flush()
        self._stream.disconnect()
