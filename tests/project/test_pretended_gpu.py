"""The pretended GPU enforces CUDA's rules, so that tests on it are meaningful."""

import threading

import numpy as np
import pytest
import torch

HAS_GPU = torch.cuda.is_available()


@pytest.fixture
def gpu(pretended_gpu):
    return pretended_gpu


def test_tensors_created_on_or_moved_to_the_gpu_report_its_device(gpu):
    created = [
        torch.zeros(3, device="cuda"), torch.tensor([1.0, 2.0], device="cuda"), torch.ones(2).to("cuda"),
        torch.as_tensor(np.ones(2), device="cuda"), torch.ones(2).cuda(), torch.randn(2, device="cuda:0"),
        torch.nn.Linear(2, 2).to("cuda").weight, torch.ones(2).to(torch.zeros(1, device="cuda")),
    ]  # fmt: skip
    created += [
        created[0].new_ones(4),
        torch.zeros_like(created[0]),
        created[0] + 1,
        created[0][:2],
        created[0].sum(),
    ]
    assert {str(tensor.device) for tensor in created} == {"cuda:0"}
    assert all(tensor.is_cuda for tensor in created)
    assert (
        created[0].cpu().device.type
        == created[0].to("cpu").device.type
        == torch.zeros(3).device.type
        == "cpu"
    )


@pytest.mark.parametrize(
    "mix",
    [
        lambda here, there: here + there,
        lambda here, there: torch.cat([here, there]),
        lambda here, there: here[torch.zeros(1, dtype=torch.long, device="cuda")],
        lambda here, there: there.index_select(0, torch.zeros(1, dtype=torch.long)),
        lambda here, there: here.add_(there.sum()),
        lambda here, there: here[:1].squeeze().mul_(there[0]),
        lambda here, there: torch.stack([there[0], torch.tensor(1.0)]),
        lambda here, there: torch.nn.functional.linear(there[None], here[None]),
    ],
)
def test_tensors_of_two_devices_do_not_mix(gpu, mix):
    with pytest.raises(RuntimeError, match="same device"):
        mix(torch.ones(3), torch.ones(3, device="cuda"))


def test_scalars_indices_and_explicit_copies_mix(gpu):
    there = torch.arange(4.0, device="cuda")
    assert (there * torch.tensor(2.0)).tolist() == [0, 2, 4, 6]
    assert there[torch.tensor([True, False, True, False])].tolist() == [0, 2]
    there[torch.tensor([1])] = torch.tensor(9.0)
    there[0] = 5
    there[2:].copy_(torch.tensor([7.0, 8.0]))
    assert there.tolist() == [5, 9, 7, 8]


def test_a_list_as_an_index_takes_the_rows_that_it_names(gpu):
    host = torch.arange(12.0).reshape(4, 3)
    on_gpu = host.to("cuda")
    for rows in ([2], [0, 3], [True, False, True, False]):
        assert torch.equal(on_gpu[rows].cpu(), host[rows])
    assert torch.equal(on_gpu[:, [2, 0]].cpu(), host[:, [2, 0]])
    on_gpu[[1, 2]] = torch.zeros(2, 3, device="cuda")
    assert on_gpu.cpu()[:, 0].tolist() == [0.0, 0.0, 0.0, 9.0]


@pytest.mark.parametrize("read", [lambda t: t.numpy(), np.asarray, lambda t: np.array(t) + 1])
def test_conversion_to_numpy_requires_a_copy_to_the_host(gpu, read):
    with pytest.raises(TypeError, match="can't convert cuda:0 device type tensor to numpy"):
        read(torch.ones(2, device="cuda"))
    assert torch.ones(2, device="cuda").cpu().numpy().tolist() == [1, 1]


def test_random_numbers_come_from_the_devices_generator(gpu):
    with pytest.raises(RuntimeError, match="generator"):
        torch.randn(2, device="cuda", generator=torch.Generator())
    with pytest.raises(RuntimeError, match="generator"):
        torch.randn(2, generator=torch.Generator("cuda"))
    first, second = (
        torch.randn(2, device="cuda", generator=torch.Generator("cuda").manual_seed(3)) for _ in range(2)
    )
    assert torch.equal(first, second)
    before = torch.get_rng_state()
    torch.randn(2, device="cuda")
    assert torch.equal(before, torch.get_rng_state())
    state = torch.cuda.get_rng_state()
    drawn = torch.rand(3, device="cuda").tolist()
    torch.cuda.set_rng_state(state)
    assert torch.rand(3, device="cuda").tolist() == drawn


def test_views_share_memory_and_in_place_operations_return_the_same_object(gpu):
    whole = torch.zeros(2, 3, device="cuda")
    row = whole[1]
    assert row.add_(2) is row
    row[:2] = 5
    whole.view(-1)[0] = 1
    assert whole.tolist() == [[1, 0, 0], [5, 5, 2]]


@pytest.mark.parametrize("fused", [False, True])
def test_a_model_trains_as_on_the_cpu(gpu, fused):
    def trained(device):
        torch.manual_seed(0)
        model = torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.ReLU(), torch.nn.Linear(8, 1)).to(device)
        inputs = torch.randn(16, 3).to(device)
        optimizer = torch.optim.Adam(model.parameters(), lr=0.01, fused=fused)
        for _ in range(3):
            optimizer.zero_grad()
            model(inputs).square().mean().backward()
            optimizer.step()
        return [parameter.detach().cpu() for parameter in model.parameters()]

    for here, there in zip(trained("cpu"), trained("cuda")):
        torch.testing.assert_close(here, there)


def test_synchronizations_are_counted(gpu):
    there = torch.ones(3, device="cuda")
    gpu.clear()
    there.mul_(2).add_(there)
    there[torch.zeros(1, dtype=torch.long, device="cuda")] = 4
    assert not gpu
    there.sum().item()
    there[there > 1]
    there.cpu()
    torch.ones(3).to("cuda")
    there.nonzero()
    assert sum(gpu.values()) == 5


def test_autocast_and_threads_work(gpu):
    layer = torch.nn.Linear(2, 2).to("cuda")
    with torch.autocast("cuda", dtype=torch.float16):
        assert layer(torch.ones(1, 2, device="cuda")).dtype == torch.float16
    with torch.inference_mode():
        assert layer(torch.ones(1, 2, device="cuda")).dtype == torch.float32
    found = []
    thread = threading.Thread(target=lambda: found.append(torch.zeros(1, device="cuda").device))
    thread.start()
    thread.join()
    assert found == [torch.device("cuda:0")]


def test_torch_is_restored_afterwards():
    assert torch.cuda.is_available() == HAS_GPU
    assert torch.Generator.__module__.startswith("torch")
    assert torch.Tensor.to is torch._C.TensorBase.to
    if HAS_GPU:
        return
    with pytest.raises((RuntimeError, AssertionError, NotImplementedError)):
        torch.zeros(1, device="cuda")
