import torch

from lexsplat.runtime.files import read_tensors, write_tensors


def test_what_is_read_starts_where_vectors_start(tmp_path):
    # 1 and 3 bytes shift everything behind them in the file.
    tensors = {f"{n}": torch.arange(n, dtype=torch.uint8) for n in (1, 3)}
    tensors |= {f"t{n}": torch.rand(n, 5) for n in (1, 2, 7)}
    write_tensors(tmp_path / "t.safetensors", tensors, {"who": "me"})
    found, metadata = read_tensors(tmp_path / "t.safetensors")
    assert metadata == {"who": "me"}
    assert set(found) == set(tensors)
    for name, tensor in found.items():
        assert torch.equal(tensor, tensors[name])
        assert tensor.data_ptr() % 64 == 0, "sums over it are those over a tensor that was never stored"
