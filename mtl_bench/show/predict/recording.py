"""A Rerun recording (.rrd): image, segments, depth and points of every frame, to scroll through."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from mtl_bench.data.labels import LabelSet
from mtl_bench.show.predict import METRES, Predicted
from mtl_bench.show.predict.point_cloud import from_prediction
from mtl_bench.show.render import overlay

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
        self._stream.save(str(path))
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
        if predicted.instance_ids_HW is not None:
            colored = overlay(predicted.image_HW3, predicted.instance_ids_HW, self.labels)
            stream.log("world/camera/panoptic", rerun.Image(colored).compress())
        if predicted.depth_HW is not None:
            metre = 1.0 if predicted.unit == METRES else None
            depth = rerun.DepthImage(predicted.depth_HW.astype(np.float32), meter=metre)
            stream.log("world/camera/depth", depth)
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
