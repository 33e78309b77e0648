"""CelebA as distributed: aligned faces, 40 attributes, the published partition.

Source: Liu et al., ICCV 2015; `Img/img_align_celeba/*.jpg` (178x218), `Anno/list_attr_celeba.txt`
(-1 or 1) and `Eval/list_eval_partition.txt` (0 train, 1 val, 2 test). Images are resized to the
recipe's size, 64x64 in the multi-task literature, as they are: neither cropped nor normalised.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core.dataset import Dataset, DecodedFrame, Kind
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.recipe import Data, Recipe
from mtl_bench.data import pictures

if TYPE_CHECKING:
    from mtl_bench.core.task import Task

IMAGES = Path("Img") / "img_align_celeba"
ATTRIBUTES = Path("Anno") / "list_attr_celeba.txt"
PARTITION = Path("Eval") / "list_eval_partition.txt"
SHOWN = 3  # examples of a problem


class CelebA(Dataset):
    """Faces, and for each of 40 attributes whether they have it."""

    has_camera = False
    labels = LabelSet("CelebA", ())
    layout, marks = "CelebA", "Anno/list_attr_celeba.txt"
    predicts: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "attributes": (
            "5_o_Clock_Shadow",
            "Arched_Eyebrows",
            "Attractive",
            "Bags_Under_Eyes",
            "Bald",
            "Bangs",
            "Big_Lips",
            "Big_Nose",
            "Black_Hair",
            "Blond_Hair",
            "Blurry",
            "Brown_Hair",
            "Bushy_Eyebrows",
            "Chubby",
            "Double_Chin",
            "Eyeglasses",
            "Goatee",
            "Gray_Hair",
            "Heavy_Makeup",
            "High_Cheekbones",
            "Male",
            "Mouth_Slightly_Open",
            "Mustache",
            "Narrow_Eyes",
            "No_Beard",
            "Oval_Face",
            "Pale_Skin",
            "Pointy_Nose",
            "Receding_Hairline",
            "Rosy_Cheeks",
            "Sideburns",
            "Smiling",
            "Straight_Hair",
            "Wavy_Hair",
            "Wearing_Earrings",
            "Wearing_Hat",
            "Wearing_Lipstick",
            "Wearing_Necklace",
            "Wearing_Necktie",
            "Young",
        )
    }
    fields: ClassVar[Mapping[str, Kind]] = dict.fromkeys(predicts["attributes"], Kind.VECTOR)
    published: ClassVar[Mapping[str, int]] = {"train": 162770, "val": 19867, "test": 19962}

    def open_split(self) -> None:
        self.faces = read_lists(self.root)
        self.names = self.faces.of_split(self.split)
        if not self.names:
            raise ValueError(f"{self.root / PARTITION}: no image of the split {self.split}")
        first = self.root / IMAGES / f"{self.names[0]}.jpg"
        if not first.is_file():
            raise ValueError(f"{first}: missing; unpack img_align_celeba.zip")

    def read(self, name: str) -> DecodedFrame:
        image_HW3 = _decoded(self.root / IMAGES / f"{name}.jpg")
        size = (self.data.width, self.data.height)
        small = cv2.resize(image_HW3, size, interpolation=cv2.INTER_AREA)
        has_40 = torch.from_numpy(self.faces.has_N40[self.faces.rows[name]].astype(np.float32))
        fields = dict(zip(self.fields, has_40.split(1), strict=True))
        return DecodedFrame(
            images_N3HW=[torch.from_numpy(small).permute(2, 0, 1)],
            fields={key: value for key, value in fields.items() if key in self.needs},
        )

    def paths(self) -> list[Path]:
        """Both lists, and the split's images."""
        lists = [self.root / ATTRIBUTES, self.root / PARTITION]
        return [*lists, *(self.root / IMAGES / f"{name}.jpg" for name in self.names)]

    @classmethod
    def recognises(cls, root: Path) -> bool:
        return (root / ATTRIBUTES).is_file()

    @classmethod
    def check(cls, root: Path, deep: bool = False) -> "CelebAReport":
        return check(root, deep)

    @classmethod
    def image_files(cls, root: Path, split: str) -> dict[str, Path]:
        return {n: root / IMAGES / f"{n}.jpg" for n in read_lists(root).of_split(split)}

    @classmethod
    def example(cls, root: Path, data: Data) -> bool:
        """Noise whose brightness tells the attributes; twelve images of each split."""
        draw = np.random.default_rng(0)
        for place in (IMAGES, ATTRIBUTES.parent, PARTITION.parent):
            (root / place).mkdir(parents=True)
        names = [f"{number:06}.jpg" for number in range(1, 12 * len(cls.splits) + 1)]
        has_N40 = draw.random((len(names), len(cls.fields))) < 0.4
        for name, has_40 in zip(names, has_N40, strict=True):
            image = draw.integers(0, 60, (218, 178, 3)) + 3 * int(has_40.sum())
            cv2.imwrite(str(root / IMAGES / name), image.astype(np.uint8))
        lines = [str(len(names)), " ".join(cls.fields)]
        for name, has_40 in zip(names, has_N40, strict=True):
            lines.append(" ".join([name, *(f"{2 * int(has) - 1:2}" for has in has_40)]))
        (root / ATTRIBUTES).write_text("\n".join(lines) + "\n")
        parts = (f"{name} {number // 12}" for number, name in enumerate(names))
        (root / PARTITION).write_text("\n".join(parts) + "\n")
        return True


# --- files ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Faces:
    """What the two lists say."""

    rows: Mapping[str, int]  # name of an image without its suffix -> its row
    has_N40: NDArray[np.bool_]
    part_N: NDArray[np.int64]  # index of the split

    def of_split(self, split: str) -> list[str]:
        part = CelebA.split_index(split)
        return [name for name, row in self.rows.items() if self.part_N[row] == part]


@lru_cache(maxsize=1)
def read_lists(root: Path) -> Faces:
    """Attributes and partition of a tree.

    Raises:
        ValueError: a list that is missing, or is not CelebA's, with its line.
    """
    lines = _lines(root / ATTRIBUTES)
    names = tuple(lines[1].split()) if len(lines) > 1 else ()
    if names != tuple(CelebA.fields):
        raise ValueError(
            f"{root / ATTRIBUTES}:2: the names of CelebA's {len(CelebA.fields)} attributes, "
            f"{next(iter(CelebA.fields))} first, stand here; this has {len(names)}"
        )
    rows: dict[str, int] = {}
    has: list[list[str]] = []
    for number, line in enumerate(lines[2:], 3):
        name, *values = line.split()
        if len(values) != len(names) or not {*values} <= {"-1", "1"}:
            raise ValueError(
                f"{root / ATTRIBUTES}:{number}: an image and {len(names)} values of -1 or 1 stand "
                f"here, not '{line[:40]}'"
            )
        rows[name.removesuffix(".jpg")] = len(has)
        has.append(values)
    part_N = np.full(len(has), -1)
    for number, line in enumerate(_lines(root / PARTITION), 1):
        name, _, part = line.partition(" ")
        name = name.removesuffix(".jpg")
        if name not in rows or part.strip() not in ("0", "1", "2"):
            raise ValueError(
                f"{root / PARTITION}:{number}: an image of {ATTRIBUTES.name} and 0, 1 or 2 stand "
                f"here, not '{line[:40]}'"
            )
        part_N[rows[name]] = int(part)
    return Faces(rows, np.array(has) == "1", part_N)


def _lines(path: Path) -> list[str]:
    if not path.is_file():
        raise ValueError(f"{path}: missing; it comes with CelebA's annotations")
    return path.read_text().splitlines()


def _decoded(path: Path) -> NDArray[np.uint8]:
    """RGB [H,W,3].

    Raises:
        ValueError: no image there.
    """
    if not path.is_file():
        raise ValueError(f"{path}: missing; unpack img_align_celeba.zip")
    return pictures.read(path)


# --- check ----------------------------------------------------------------------------------------


@dataclass
class CelebAReport:
    """What `check` found."""

    root: Path
    present: dict[str, tuple[int, int]] = field(default_factory=dict)  # by split: images, listed
    sizes: set[tuple[int, int]] = field(default_factory=set)  # height, width of decoded images
    range: tuple[int, int] = (255, 0)  # of their values
    share: dict[str, float] = field(default_factory=dict)  # of images that have an attribute
    problems: list[str] = field(default_factory=list)

    @property
    def dataset(self) -> str:
        return CelebA.name

    def summary(self) -> list[str]:
        lines = [f"{self.root}: {CelebA.layout}"]
        for split, (images, listed) in self.present.items():
            published = CelebA.published[split]
            lines.append(f"{split}: {images} images of {listed} listed, {published} published")
        sizes = ", ".join(f"{height}x{width}" for height, width in sorted(self.sizes))
        if self.sizes:
            lines.append(f"images {sizes}, uint8, values {self.range[0]} to {self.range[1]}")
        lines += [f"  {name}: {100 * share:.1f} % have it" for name, share in self.share.items()]
        lines += [f"{len(self.problems)} problems"] if self.problems else []
        lines += [f"  {text}" for text in self.problems[:SHOWN]]
        more = len(self.problems) - SHOWN
        return lines + ([f"  and {more} more"] if more > 0 else [])

    def recipe_lines(self, recipe: Recipe, tasks: "Sequence[Task]") -> Iterator[str]:
        yield f"recipe {recipe.name}, {len(tasks)} tasks: " + (
            f"{len(self.problems)} problems" if self.problems else "ready"
        )


def check(root: Path, deep: bool = False) -> CelebAReport:
    """Look over a tree: both lists, and an image for every line.

    Args:
        deep: decode every image, not each split's first.
    """
    report = CelebAReport(root)
    try:
        faces = read_lists(root)
    except ValueError as error:
        report.problems.append(str(error))
        return report
    without = int((faces.part_N < 0).sum())
    if without:
        report.problems.append(f"{root / PARTITION}: {without} images are in no split")
    report.share = dict(zip(CelebA.fields, faces.has_N40.mean(0).tolist(), strict=True))
    folder = root / IMAGES
    there = {path.stem for path in folder.glob("*.jpg")}
    for split in CelebA.splits:
        names = faces.of_split(split)
        present = [name for name in names if name in there]
        report.present[split] = (len(present), len(names))
        if not names:
            report.problems.append(f"{root / PARTITION}: no image of the split {split}")
        if len(present) < len(names):
            first = next(name for name in names if name not in there)
            lacking = len(names) - len(present)
            report.problems.append(f"{folder / first}.jpg and {lacking - 1} others: missing")
        for name in present if deep else present[:1]:
            try:
                image = _decoded(folder / f"{name}.jpg")
            except ValueError as error:
                report.problems.append(str(error))
                continue
            report.sizes.add((image.shape[0], image.shape[1]))
            low, high = report.range
            report.range = (min(low, int(image.min())), max(high, int(image.max())))
    return report
