"""The built-in data set: procedural street scenes as videos, in Cityscapes' layout or KITTI's.

`ensure` renders it into the user's cache on first use, `write` into a folder of choice. Every scene
depends on the seed and its own number alone, so that their count and order leave no trace in the
bytes. The folder appears under its name by a rename at the very end: what has the name is whole.

From a street to files: `rays` (camera, solids, what a ray hits), `surfaces` (materials), `objects`
(what stands and drives), `street` (where), `render` (images and truth), `cityscapes` and `kitti`
(files), `make` (the set).
"""

from mtl_bench.data.scenes.make import ensure, made_from, write

__all__ = ["ensure", "made_from", "write"]
