"""Adam and AdamW give the bits of torch's, and have its state."""

import pytest
import torch

from lexsplat.runtime import adam


@pytest.mark.parametrize("name", ["Adam", "AdamW"])
@pytest.mark.parametrize("options", [{}, {"weight_decay": 0.1}, {"fused": True, "eps": 1e-15}], ids=str)
def test_steps_have_the_bits_of_torch(name, options):
    results, states = [], []
    for module in (adam, torch.optim):
        parameter = torch.nn.Parameter(torch.linspace(-1, 1, 50))
        optimizer = getattr(module, name)([parameter], lr=0.02, **options)
        for step in range(4):
            optimizer.zero_grad()
            (parameter.sin() * (step + 1)).sum().backward()
            optimizer.step()
        again = getattr(module, name)([parameter], lr=0.5)
        again.load_state_dict(optimizer.state_dict())
        results.append(parameter.detach())
        states.append(again.state_dict())
    assert torch.equal(*results)
    assert states[0]["param_groups"] == states[1]["param_groups"]
    for key, value in states[0]["state"][0].items():
        assert torch.equal(value, states[1]["state"][0][key]), key


def test_steps_are_outside_of_the_graph_of_gradients():
    parameter = torch.nn.Parameter(torch.ones(3))
    parameter.grad = torch.ones(3)
    adam.Adam([parameter], lr=0.1).step()
    assert parameter.is_leaf
    assert torch.is_grad_enabled()
