"""Cityscapes' classes, which every built-in reader labels with.

Source: Cityscapes' label definitions; the 20th training class `ego vehicle` and the order (class
index 0, the rest shifted) are MGNet's.
"""

from mtl_bench.core.labels import GROUND, NO_SURFACE, Label, LabelSet

_EGO = Label("ego vehicle", 1, False, (72, 209, 204), evaluated=False, role=NO_SURFACE)
_EVALUATED = (
    Label("road", 7, False, (128, 64, 128), role=GROUND),
    Label("sidewalk", 8, False, (244, 35, 232)),
    Label("building", 11, False, (70, 70, 70)),
    Label("wall", 12, False, (102, 102, 156)),
    Label("fence", 13, False, (190, 153, 153)),
    Label("pole", 17, False, (153, 153, 153)),
    Label("traffic light", 19, False, (250, 170, 30)),
    Label("traffic sign", 20, False, (220, 220, 0)),
    Label("vegetation", 21, False, (107, 142, 35)),
    Label("terrain", 22, False, (152, 251, 152)),
    Label("sky", 23, False, (70, 130, 180), role=NO_SURFACE),
    Label("person", 24, True, (220, 20, 60)),
    Label("rider", 25, True, (255, 0, 0)),
    Label("car", 26, True, (0, 0, 142)),
    Label("truck", 27, True, (0, 0, 70)),
    Label("bus", 28, True, (0, 60, 100)),
    Label("train", 31, True, (0, 80, 100)),
    Label("motorcycle", 32, True, (0, 0, 230)),
    Label("bicycle", 33, True, (119, 11, 32)),
)

CITYSCAPES20 = LabelSet("cityscapes20", (_EGO, *_EVALUATED))
CITYSCAPES19 = LabelSet("cityscapes19", _EVALUATED)  # of cameras that do not see their own car

# Every label id that Cityscapes' files may hold; those in no LabelSet are void. -1 is not written.
KNOWN_LABEL_IDS = frozenset(range(34))
