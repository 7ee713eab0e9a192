"""Adam and AdamW that do not import torch's compiler, which nothing here uses.

An optimizer of torch imports the compiler when it is made, and with it sympy: 800 modules, which take as long as
torch itself. It does so to keep the compiler out of its methods. The classes below have the methods alone, whose
results are the same bits.
"""

from __future__ import annotations

import inspect
from typing import Any

import torch


def _methods(base: type[torch.optim.Optimizer]) -> dict[str, Any]:
    """The methods of an optimizer without what is around them; a step has no gradients."""
    names = ("add_param_group", "load_state_dict", "state_dict", "step", "zero_grad")
    methods: dict[str, Any] = {name: inspect.unwrap(getattr(base, name)) for name in names}
    return methods | {"step": torch.no_grad()(methods["step"])}


Adam: type[torch.optim.Adam] = type("Adam", (torch.optim.Adam,), _methods(torch.optim.Adam))
AdamW: type[torch.optim.AdamW] = type("AdamW", (torch.optim.AdamW,), _methods(torch.optim.AdamW))
