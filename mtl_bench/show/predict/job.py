"""Predictions for a user's images or video: from files through the model into a folder.

    <out>/prediction.json    input, cameras, scale, model, speed; the units of the other files
    <out>/NAME_...           of images, see `files`
    <out>/NAME.mp4           of a video: the tasks' pictures side by side
    <out>/NAME_000000_...    of a video's frames, where they are asked for

One frame is in memory at a time. The folder appears under its name, whole, at the very end.
"""

import contextlib
import json
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mtl_bench.core.canvas import Image
from mtl_bench.core.files import is_litter
from mtl_bench.core.view import STEPS, Surface
from mtl_bench.data import pictures
from mtl_bench.data.cameras import Mounted
from mtl_bench.data.video import Reader, Writer
from mtl_bench.show.predict import Predicted, Predictor
from mtl_bench.show.predict.cameras import Given, camera_of
from mtl_bench.show.predict.files import video_frame, write_files
from mtl_bench.show.predict.recording import Recording, missing

RECORD = "prediction.json"
MOST = 0.98  # of the frames that a video announces, by its length: fewer, and it was cut off
Progress = Callable[[int, int], None]  # frames done, frames in all (0: not known)


@dataclass
class Job:
    """What is done with every frame, and what came of it so far."""

    predictor: Predictor
    given: Given
    kinds: Collection[str]  # of files; what the cell's tasks lack is left out
    recording: Recording | None = None
    progress: Progress | None = None
    frames: int = 0
    predict_s: float = 0.0
    scales: Counter[str] = field(default_factory=Counter)  # "m by road": frames
    steps: dict[str, int] = field(default_factory=dict)  # of frames whose depth files have others
    began: float = field(default_factory=time.perf_counter)

    def predict(self, name: str, image_HW3: Image, camera: Mounted) -> Predicted:
        """Predict a frame, count it, and log it where there is a recording."""
        start = time.perf_counter()
        predicted = self.predictor(image_HW3, camera.K_33, camera.height_m, camera.pitch_rad)
        self.predict_s += time.perf_counter() - start
        if predicted.surface is not None:
            self.scales[_scale_in_words(predicted.surface)] += 1
            if predicted.surface.steps != STEPS:
                self.steps[name] = predicted.surface.steps
        if self.recording is not None:
            self.recording.add(self.frames, name, predicted)
        return predicted

    def done(self, total: int) -> None:
        """A frame and its files."""
        self.frames += 1
        if self.progress is not None:
            self.progress(self.frames, total)

    @property
    def fps(self) -> float:
        return self.frames / (time.perf_counter() - self.began)

    @property
    def record(self) -> dict[str, Any]:
        return {
            "frames": self.frames,
            "network_size": list(self.predictor.size),
            "depth": dict(self.scales),
            "depth_steps": STEPS,  # of a unit, in NAME_depth.png
            "depth_steps_of": self.steps,
            "fps": self.fps,
            "fps_of_predicting": self.frames / self.predict_s,  # without reading and writing
        }


# --- images and videos ----------------------------------------------------------------------------


def predict_images(job: Job, paths: Sequence[Path], folder: Path) -> dict[str, Any]:
    """Predict images one by one and write their files; returns what to record of them.

    An image that cannot be predicted is recorded as failed, and the others go on.

    Raises:
        ValueError: names that are there twice, or not one image that can be predicted.
    """
    images, failed = [], []
    for path, stem in zip(paths, stems_of(paths), strict=True):
        try:
            image_HW3 = pictures.read(path)
            camera = camera_of(path, (image_HW3.shape[0], image_HW3.shape[1]), job.given)
            predicted = job.predict(stem, image_HW3, camera)
        except ValueError as error:
            failed.append({"input": str(path), "why": str(error)})
            continue
        base = folder / stem
        base.parent.mkdir(parents=True, exist_ok=True)
        write_files(base, predicted, job.kinds, job.predictor.labels)
        image = {"input": str(path), "name": stem, "size": list(image_HW3.shape[:2])}
        surface = predicted.surface
        unit, source = (surface.unit, surface.source) if surface else (None, None)
        scale = {"unit": unit, "scale_from": source}
        images.append({**image, "camera": _camera(camera), **scale})
        job.done(len(paths))
    if not images:
        others = f" ({len(failed)} images, and none can be predicted)" if len(failed) > 1 else ""
        raise ValueError(failed[0]["why"] + others)
    return {**job.record, "images": images, "failed": failed}


def predict_video(job: Job, paths: Sequence[Path], folder: Path) -> dict[str, Any]:
    """Predict the one video frame by frame into a video; returns what to record of it.

    Raises:
        ValueError: no video, no frame in it, an impossible camera, a full disk.
    """
    (path,) = paths
    reader = Reader(path)
    camera = camera_of(path, reader.size, job.given)
    video = folder / f"{path.stem}.mp4"
    with Writer(video, reader.fps) as writer:
        for number, image_HW3 in enumerate(reader):
            stem = f"{path.stem}_{number:06d}"
            predicted = job.predict(stem, image_HW3, camera)
            writer.write(video_frame(predicted))
            write_files(folder / stem, predicted, job.kinds, job.predictor.labels)
            job.done(reader.frames)
    about = {"input": str(path), "size": list(reader.size), "video_fps": reader.fps}
    about |= {"camera": _camera(camera), "video": video.name, "failed": []}
    if job.frames < MOST * reader.frames - 1:
        why = f"{path}: {job.frames} of {reader.frames} frames can be decoded; is the file whole?"
        about["failed"] = [{"input": str(path), "why": why}]
    return {**job.record, **about}


def is_video(paths: Sequence[Path]) -> bool:
    """Whether the input is one file that is no image."""
    return len(paths) == 1 and not pictures.is_image(paths[0])


def _camera(camera: Mounted) -> dict[str, Any]:
    fx, fy, cx, cy = camera.K_33[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "source": camera.source}
    return {**values, "height_m": camera.height_m, "pitch_rad": camera.pitch_rad}


def _scale_in_words(surface: Surface) -> str:
    found = surface.camera_height is not None
    return f"{surface.unit}, scale from {surface.source if found else 'nowhere'}"


def summary(record: dict[str, Any], predictor: Predictor) -> list[str]:
    """What a user should know of a run before trusting its depth."""
    cameras = [image["camera"] for image in record.get("images", [record])]
    sources = {camera["source"] for camera in cameras}
    shown = sorted(sources, key=lambda source: (not source.startswith("guessed"), source))[:3]
    lines = [f"intrinsics: {source}" for source in shown]
    lines += [f"intrinsics of others: see {RECORD}"] * (len(sources) > len(shown))
    lines += [f"depth in {scale}: {count} frames" for scale, count in record["depth"].items()]
    size = record.get("images", [record])[0]["size"]
    better = predictor.unsqueezed(size[0], size[1])
    if better is not None:
        rows, columns = predictor.size
        lines.append(
            f"note: {size[0]}x{size[1]} was squeezed to {rows}x{columns}; "
            f"--size {better[0]}x{better[1]} would keep its shape"
        )
    return lines


# --- in and out -----------------------------------------------------------------------------------


def find(words: Sequence[str]) -> list[Path]:
    """Files that images, folders (searched to their depths) and patterns mean, in that order.

    Symbolic links are followed; files that only an operating system looks at are left out.

    Raises:
        ValueError: nothing there.
    """
    found: list[Path] = []
    for word in words:
        path = Path(word)
        if path.is_dir():
            inside = _images_below(path)
            if not inside:
                raise ValueError(
                    f"{path}: no image in this folder ({', '.join(pictures.SUFFIXES)})"
                )
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            matches = sorted(p for p in _matches(path) if p.is_file() and not is_litter(p.name))
            if not matches:
                raise ValueError(f"no file, folder or pattern with files '{word}'")
            found += matches
    return found


def _images_below(folder: Path) -> list[Path]:
    """In order; what several links lead to is there once, also where they lead in a circle."""
    found: list[Path] = []
    seen: set[Path] = set()

    def refuse(error: OSError) -> None:
        raise ValueError(f"{error.filename}: cannot be listed ({error.strerror})") from error

    for place, folders, files in os.walk(folder, onerror=refuse, followlinks=True):
        if (real := Path(place).resolve()) in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not is_litter(name))
        names = [name for name in files if not is_litter(name)]
        found += [Path(place, n) for n in names if Path(n).suffix.lower() in pictures.SUFFIXES]
    return sorted(found)


def _matches(pattern: Path) -> Iterator[Path]:
    return Path(pattern.anchor).glob(str(pattern.relative_to(pattern.anchor)))


@contextlib.contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """A temporary sibling, which takes the place of `out` unless something goes wrong.

    Raises:
        ValueError: `out` is there already, and not an empty folder.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise ValueError(f"{out} exists and is not an empty folder: name a new one, or remove it")
    partial = out.with_name(f".{out.name}.partial-{os.urandom(6).hex()}")
    partial.mkdir(parents=True)
    try:
        yield partial
        partial.replace(out)  # on Linux an empty folder is replaced, too
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def stems_of(paths: Sequence[Path]) -> list[str]:
    """Names of outputs: the inputs' below the folder that they have in common."""
    parents = [Path(os.path.abspath(path)).parent for path in paths]  # noqa: PTH100  links stay
    common = os.path.commonpath(parents)
    stems = [
        (parent / path.stem).relative_to(common).as_posix()
        for path, parent in zip(paths, parents, strict=True)
    ]
    twice = [stem for stem, count in Counter(stems).items() if count > 1]
    if twice:
        raise ValueError(
            f"{len(twice)} names are there twice, such as '{twice[0]}': run them apart"
        )
    return stems


def write_record(folder: Path, record: dict[str, Any]) -> None:
    text = json.dumps(record, indent=1)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")


@contextlib.contextmanager
def recorded(job: Job, path: Path | None) -> Iterator[None]:
    """Log the job's frames into a Rerun file, which appears when all went well.

    Raises:
        ValueError: rerun-sdk is not installed.
    """
    if path is None:
        yield
        return
    why = missing()
    if why:
        raise ValueError(why)
    temporary = path.with_name(f".{path.name}.{os.urandom(6).hex()}.tmp")
    try:
        job.recording = Recording(temporary, job.predictor.labels)
        yield
        job.recording.close()
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
