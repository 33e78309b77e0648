"""The table of materials: what paints each one, how rough it is, and how it is filtered."""

from collections.abc import Callable

import numpy as np

from mtl_bench.data.synthetic import bodies, grounds
from mtl_bench.data.synthetic.camera import FloatArray
from mtl_bench.data.synthetic.material import Material, Patch

#: function, noise strength per wavelength (17, 6.4, 2.3, .85, .32, .12, .045 m)
PATCHES: dict[Material, tuple[Callable[[Patch], FloatArray], tuple[float, ...]]] = {
    Material.PLAIN: (grounds.plain, (0.0, 0.1, 0.2, 0.25, 0.25, 0.2, 0.15)),
    Material.FACADE: (grounds.facade, (0.6, 0.9, 0.75, 0.35, 0.25, 0.2, 0.2)),
    Material.ASPHALT: (grounds.asphalt, (1.0, 1.1, 1.3, 1.0, 0.6, 0.35, 0.25)),
    Material.PAVING: (grounds.paving, (0.8, 0.5, 0.9, 0.7, 0.4, 0.3, 0.2)),
    Material.GRASS: (grounds.grass, (0.8, 0.5, 0.9, 0.6, 0.5, 0.45, 0.4)),
    Material.FOLIAGE: (grounds.foliage, (0.0, 0.0, 0.4, 0.5, 0.6, 0.8, 0.8)),
    Material.SLATS: (grounds.slats, (0.0, 0.25, 0.3, 0.3, 0.25, 0.2, 0.15)),
    Material.MASONRY: (grounds.masonry, (0.0, 0.35, 0.4, 0.4, 0.3, 0.25, 0.2)),
    Material.BODY: (bodies.body, (0.0, 0.0, 0.15, 0.2, 0.15, 0.1, 0.05)),
    Material.CABIN: (bodies.cabin, (0.0, 0.0, 0.15, 0.2, 0.15, 0.1, 0.05)),
    Material.COACH: (bodies.coach, (0.0, 0.1, 0.2, 0.22, 0.16, 0.1, 0.05)),
    Material.SIGN: (bodies.sign, (0.0, 0.0, 0.0, 0.06, 0.06, 0.05, 0.05)),
    Material.LAMPS: (bodies.lamps, (0.0, 0.0, 0.0, 0.06, 0.06, 0.05, 0.05)),
    Material.PERSON: (bodies.person, (0.0, 0.0, 0.1, 0.2, 0.25, 0.25, 0.15)),
    Material.WHEEL: (bodies.wheel, (0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.1)),
    Material.HEAD: (bodies.head, (0.0, 0.0, 0.0, 0.05, 0.05, 0.05, 0.05)),
    Material.ROOF: (grounds.roof, (0.0, 0.25, 0.3, 0.3, 0.25, 0.2, 0.15)),
}
#: share of the street's direction in the noise: wear runs along the road, and a pixel is long there
_STRETCH = {Material.ASPHALT: 0.7, Material.PAVING: 0.7, Material.GRASS: 0.7}
_STRETCH |= dict.fromkeys((Material.FACADE, Material.SLATS, Material.MASONRY), 0.6)
#: width of the patterns' filter in pixels: wide where surfaces are large and pass close by, as
#: whoever warps a frame interpolates between its pixels; narrow on small things, to keep their look
_FILTER = dict.fromkeys((Material.PAVING, Material.SLATS, Material.MASONRY), 3.5)
_FILTER |= dict.fromkeys((Material.BODY, Material.CABIN, Material.COACH), 2.2)
_FILTER |= {Material.ASPHALT: 5.0, Material.FACADE: 4.5, Material.ROOF: 3.0}
#: share of the pixel at which noise is faded: leaves may be finer than what interpolation likes
_FINE = {Material.FOLIAGE: 0.5, Material.PERSON: 0.7}
OCTAVES = np.array([PATCHES[m][1] for m in Material], np.float32)
ALONG = np.array([_STRETCH.get(m, 1.0) for m in Material], np.float32)
FILTER_PX = np.array([_FILTER.get(m, 1.2) for m in Material], np.float32)
FINE = np.array([_FINE.get(m, 1.0) for m in Material], np.float32)
