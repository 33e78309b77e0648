"""The engines that are found, and what each can do: read from their files, importing none.

One engine a file, here, in `./engines` and in the folders of `--plugins`: see `core.engine`.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mtl_bench.core import plugins

if TYPE_CHECKING:
    from mtl_bench.core.engine import Engine

REFERENCE = "plain"  # the network as it was trained, float32: what the others are compared with


@dataclass(frozen=True)
class Facts:
    """What an engine's class declares."""

    precisions: dict[str, tuple[str, ...]]  # kind of device -> precisions
    packages: tuple[str, ...]
    extra: tuple[str, ...]

    @property
    def text(self) -> str:
        """`fp32, bf16 on cpu; fp32 on cuda`."""
        return "; ".join(f"{', '.join(p)} on {kind}" for kind, p in self.precisions.items())


def names() -> list[str]:
    """Of the engines that are not broken: the reference, those without further packages, others."""
    found = [about.name for about in plugins.describe("engines") if not about.error]
    return sorted(found, key=lambda name: (name != REFERENCE, facts(name).extra != (), name))


def facts(name: str) -> Facts:
    """What an engine declares, from its file's text; imported where that has no literals.

    Raises:
        ValueError: no such engine.
    """
    values: dict[str, Any] = plugins.attributes("engines", name)
    if "precisions" not in values:
        engine = load(name)
        return Facts(dict(engine.precisions), engine.packages, engine.extra)
    return Facts(values["precisions"], values.get("packages", ("torch",)), values.get("extra", ()))


def available(name: str) -> str | None:
    """None, or why the engine cannot run here and what would change that.

    Raises:
        ValueError: no such engine, or a broken one.
    """
    return load(name).lack()


def check(name: str, precision: str, device: str) -> None:
    """An engine has this precision on this kind of device (cpu, cuda).

    Raises:
        ValueError: no such engine, or it does not; says what it has.
    """
    found = facts(name)
    if precision not in found.precisions.get(device, ()):
        raise ValueError(f"engine {name} has no {precision} on {device}: it has {found.text}")


def load(name: str) -> "type[Engine]":
    found: type[Engine] = plugins.load("engines", name)
    return found
