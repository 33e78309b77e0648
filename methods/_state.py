"""Memory of one gradient per task, whose length is known only when the first one comes.

An empty buffer stands for zeros until then; loading a state gives it the size that it had there.
"""

from typing import Any

import torch
from torch import Tensor, nn


class Rows(nn.Module):
    """[T,P]: `of` reads the rows of the tasks that are present, `keep` replaces them.

    Args:
        tasks: T.
    """

    rows_TP: Tensor

    def __init__(self, tasks: int):
        super().__init__()
        self.register_buffer("rows_TP", torch.zeros(tasks, 0))

    def of(self, present: Tensor, J_KP: Tensor) -> Tensor:
        """The present tasks' rows, of the type and device of J; not to be changed in place."""
        if not self.rows_TP.numel():
            self.rows_TP = J_KP.new_zeros(len(self.rows_TP), J_KP.shape[1])
        everyone = len(present) == len(self.rows_TP)  # then nothing needs to be copied
        return self.rows_TP if everyone else self.rows_TP[present]

    def keep(self, present: Tensor, rows_KP: Tensor) -> None:
        if len(present) == len(self.rows_TP):
            self.rows_TP = rows_KP
        else:
            self.rows_TP[present] = rows_KP

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        self.rows_TP = torch.empty_like(state_dict[prefix + "rows_TP"], device=self.rows_TP.device)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
