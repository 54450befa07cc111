"""Derivatives held against differences of answers without gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


def check(answer: Callable[..., Any], *tensors: Any, second: bool = True, step: float = 1e-6) -> None:
    """First and second derivatives of an answer by finite differences, in float64, bit for bit the same twice."""
    given = tuple(tensor.detach().clone().requires_grad_() for tensor in tensors)
    assert torch.autograd.gradcheck(answer, given, eps=step, atol=1e-5, rtol=1e-4, nondet_tol=0.0, fast_mode=True)
    if second:
        assert torch.autograd.gradgradcheck(answer, given, eps=step, atol=1e-4, rtol=1e-3, fast_mode=True)


def tensor(values: Any) -> Any:
    return torch.tensor(values, dtype=torch.float64)
