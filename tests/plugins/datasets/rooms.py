"""Indoor rooms in a layout of their own: `<split>/<name>.{jpg,ids.png,depth.npy}` and `camera.txt`.

Source: made up, to show that a reader is one file. Other classes than a street's, no video.
"""

import cv2
import numpy as np
import torch

from mtl_bench.core.dataset import Dataset, DecodedFrame, Kind
from mtl_bench.core.geometry import scale_intrinsics
from mtl_bench.core.labels import GROUND, Label, LabelSet

LABELS = LabelSet(
    "rooms",
    (
        Label("floor", 1, False, (120, 90, 60), role=GROUND),
        Label("wall", 2, False, (200, 200, 190)),
        Label("chair", 3, True, (200, 60, 60)),
        Label("table", 4, True, (60, 60, 200)),
    ),
)
CAMERA = "camera.txt"  # fx fy cx cy height_m


class Rooms(Dataset):
    labels = LABELS
    fields = {"instance_ids": Kind.IDS, "depth_m": Kind.DEPTH}
    layout, marks = "Rooms", CAMERA

    def open_split(self):
        folder = self.root / self.split
        self.names = sorted(path.stem for path in folder.glob("*.jpg"))
        if not self.names:
            raise ValueError(f"{folder}: no *.jpg in it")
        fx, fy, cx, cy, self.height_m = np.loadtxt(self.root / CAMERA)
        self.K_33 = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float32)

    @classmethod
    def recognises(cls, root):
        return (root / CAMERA).is_file()

    def read(self, name):
        folder = self.root / self.split
        image = cv2.cvtColor(cv2.imread(str(folder / f"{name}.jpg")), cv2.COLOR_BGR2RGB)
        ids = cv2.imread(str(folder / f"{name}.ids.png"), cv2.IMREAD_UNCHANGED).astype(np.int32)
        depth = np.load(folder / f"{name}.depth.npy")
        rows, columns = image.shape[:2]
        size = (self.data.width, self.data.height)
        K_33 = scale_intrinsics(self.K_33[None], size[0] / columns, size[1] / rows)[0]
        if self.training:
            ids, depth = (
                cv2.resize(map_, size, interpolation=cv2.INTER_NEAREST) for map_ in (ids, depth)
            )
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        maps = {"instance_ids": torch.from_numpy(ids), "depth_m": torch.from_numpy(depth)}
        return DecodedFrame(
            images_N3HW=[torch.from_numpy(small).permute(2, 0, 1)],
            K_33=K_33,
            camera_height_m=float(self.height_m),
            fields={key: value for key, value in maps.items() if key in self.needs},
        )

    @classmethod
    def example(cls, root, data):
        draw = np.random.default_rng(0)
        height, width = 2 * data.height, 2 * data.width
        for split, count in (("train", 4), ("val", 2)):
            (root / split).mkdir(parents=True)
            for number in range(count):
                ids = np.full((height, width), 2, np.uint16)
                ids[height // 2 :] = 1
                top, left = draw.integers(height // 4, height // 2, 2)
                ids[top : top + height // 4, left : left + width // 4] = 3000 + number
                depth = np.full((height, width), 6.0, np.float32)
                depth[height // 2 :] = np.linspace(6, 2, height - height // 2)[:, None]
                image = draw.integers(0, 256, (height, width, 3)).astype(np.uint8) // 8
                image += (ids[..., None] % 7 * 30).astype(np.uint8)
                base = root / split / f"room{number}"
                cv2.imwrite(f"{base}.jpg", image)
                cv2.imwrite(f"{base}.ids.png", ids)
                np.save(f"{base}.depth.npy", depth)
        (root / CAMERA).write_text(f"{width} {width} {width / 2} {height / 2} 1.5\n")
        return True
