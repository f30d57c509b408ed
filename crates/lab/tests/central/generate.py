#!/usr/bin/env python3
"""Write PyTorch's results for the ten functions of `ten.rs`: fixtures with gradients, and verdicts of torch.autograd.gradcheck.

    python3 crates/lab/tests/central/generate.py      # writes fixtures/*.safetensors and fixtures/verdicts.json

Five functions are right. In the other five a bug is planted: the value is right and the gradient is not, or the point has no
gradient. The tests read these files and never run Python. `verdicts.json` has for each function what gradcheck says with its
default settings, in the fast mode for the million elements, whose full Jacobian would have 10^12 entries.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[4] / "scripts"))
from fixtures import write_fixture  # noqa: E402

HERE = Path(__file__).resolve().parent / "fixtures"
MILLION = 1_000_000
WRONG_AT = 654_321


def normal(seed, *shape):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


def matmul(a, b):
    return a @ b


def softmax(x):
    return torch.softmax(x, 1)


def sin_exp(x, y):
    return torch.sin(x * y) * torch.exp(0.5 * y) + torch.tanh(x)


def norm(x):
    return x / (x * x).sum(1, keepdim=True).sqrt()


def cumprod(x):
    """In the form of transmittances: the product of all 1 - x before."""
    return x * torch.exp(torch.cumsum(torch.log1p(-x), 1) - torch.log1p(-x))


def wrong_factor(x):
    """The gradient is 1 % too large."""
    y = torch.sin(x)
    return y + 0.01 * (y - y.detach())


def missing_term(x):
    """x sin x without the derivative of the first factor."""
    return x.detach() * torch.sin(x)


def detached_input(x, y):
    return x * torch.exp(y.detach())


def one_in_a_million(x):
    """The gradient of one element is 1 % too large."""
    y = torch.sin(x)
    mask = torch.zeros_like(x)
    mask[WRONG_AT] = 0.01
    return y + mask * (y - y.detach())


def kink(x):
    """ReLU, one element at zero exactly."""
    return torch.relu(x)


def million():
    """Multiples of 2^-30 from -2 to 2: the same doubles in every language."""
    i = np.arange(MILLION, dtype=np.uint64)
    return torch.from_numpy(((i * np.uint64(2654435761)) % np.uint64(1 << 32)).astype(np.float64) / (1 << 30) - 2.0)


CASES = {
    "matmul": (matmul, {"a": normal(1, 4, 5), "b": normal(2, 5, 3)}),
    "softmax": (softmax, {"x": normal(3, 4, 6)}),
    "sin_exp": (sin_exp, {"x": normal(4, 3, 4), "y": normal(5, 3, 4)}),
    "norm": (norm, {"x": normal(6, 5, 3)}),
    "cumprod": (cumprod, {"x": torch.sigmoid(normal(7, 3, 8))}),
    "wrong_factor": (wrong_factor, {"x": normal(8, 3, 4)}),
    "missing_term": (missing_term, {"x": normal(9, 3, 4)}),
    "detached_input": (detached_input, {"x": normal(10, 3, 4), "y": normal(11, 3, 4)}),
    "one_in_a_million": (one_in_a_million, {"x": million()}),
    "kink": (kink, {"x": torch.cat([normal(12, 5), torch.zeros(1, dtype=torch.float64)]).reshape(2, 3)}),
}


def jacobian_errors(function, inputs):
    """Return the largest difference of PyTorch's numeric and analytic Jacobian, relative to the largest entry."""
    from torch.autograd.gradcheck import _get_analytical_jacobian, _get_numerical_jacobian

    leaves = tuple(x.clone().requires_grad_() for x in inputs.values())
    outputs = function(*leaves)
    numeric = _get_numerical_jacobian(function, leaves, (outputs,), eps=1e-6)
    worst = 0.0
    for i, numeric_of_input in enumerate(numeric):
        if not outputs.requires_grad:
            return None
        analytic = _get_analytical_jacobian(leaves, (outputs,), i, 0)
        gap = (analytic - numeric_of_input[0]).abs().max() / numeric_of_input[0].abs().max()
        worst = max(worst, float(gap))
    return worst


def verdict(name, function, inputs):
    leaves = tuple(x.clone().requires_grad_() for x in inputs.values())
    fast = name == "one_in_a_million"
    result = torch.autograd.gradcheck(function, leaves, raise_exception=False, fast_mode=fast)
    entry = {"passes": bool(result), "fast_mode": fast}
    if not fast:
        entry["worst_error"] = jacobian_errors(function, inputs)
    return entry


def main():
    torch.set_num_threads(1)
    HERE.mkdir(exist_ok=True)
    verdicts = {"torch": torch.__version__, "functions": {}}
    for name, (function, inputs) in CASES.items():
        entry = verdict(name, function, inputs)
        if name == "one_in_a_million":
            # The fixture would take 32 MB; a few of its gradients suffice.
            x = inputs["x"].clone().requires_grad_()
            (gradient,) = torch.autograd.grad(function(x).sum(), x)
            places = [0, 1, WRONG_AT - 1, WRONG_AT, WRONG_AT + 1, MILLION - 1]
            entry["gradient"] = {str(i): float(gradient[i]) for i in places}
        else:
            write_fixture(HERE / f"{name}.safetensors", function, inputs, case=(function.__doc__ or "").strip())
        verdicts["functions"][name] = entry
        print(name, entry)
    (HERE / "verdicts.json").write_text(json.dumps(verdicts, indent=1) + "\n")


if __name__ == "__main__":
    main()
