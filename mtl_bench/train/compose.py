"""A method by its name: one file's, or of `a+b+c` those of its parts, composed."""

from collections.abc import Mapping, Sequence
from typing import Any

from mtl_bench.core import plugins
from mtl_bench.core.method import Composed, GradientMethod, LossMethod, Method, Wrapper
from mtl_bench.core.terms import Term


def compose(name: str, settings: Mapping[str, Any], terms: Sequence[Term], seed: int) -> Method:
    """A method over these terms.

    Args:
        settings: hyper-parameters; of a composition by part.

    Raises:
        ValueError: an unknown name, or parts that are not at most one loss-value method, then
            wrappers, then a gradient method.
    """
    names = plugins.part_names(name)
    of = {name: settings} if len(names) == 1 else settings
    parts = [plugins.load("methods", n)(terms, seed=seed, **of.get(n, {})) for n in names]
    if len(parts) == 1:
        whole: Method = parts[0]
        return whole
    first = [parts.pop(0)] if isinstance(parts[0], LossMethod) else []
    wrappers, last = parts[:-1], parts[-1:]
    if not all(isinstance(part, Wrapper) for part in wrappers) or not all(
        isinstance(part, GradientMethod) for part in last
    ):
        raise ValueError(
            f"method '{name}' is not a loss-value method + a gradient method, with wrappers before "
            f"the latter; mtl-bench list methods says which is which"
        )
    for wrapper in reversed(wrappers):
        last = [wrapper.around(*last)]
    found: Method = Composed(*first, *last) if first else last[0]
    return found
