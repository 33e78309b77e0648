"""Figures of a trained cell's predictions: for print, and one to walk through in a browser."""

from mtl_bench.show.figures.cloud_page import cloud_page
from mtl_bench.show.figures.files import write_whole
from mtl_bench.show.figures.frames import Shown, choose, frames_in, load, look, told_apart
from mtl_bench.show.figures.printed import prediction, qualitative, write

__all__ = ["Shown", "choose", "cloud_page", "frames_in", "load", "look", "prediction"]
__all__ += ["qualitative", "told_apart", "write", "write_whole"]
