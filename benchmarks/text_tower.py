"""Start of the text tower: ours, transformers' and ONNX Runtime's, each in a process of its own.

    python benchmarks/text_tower.py [--repeats 9] [--json FILE]

Each process loads a model folder and embeds `PHRASES`: "ours" by `lexsplat.features.clip_text`, "transformers" by
CLIPTextModelWithProjection, "ONNX Runtime" by a model exported beforehand (needs the packages onnx, onnxscript
and onnxruntime; without torch in the process, and again with it, as scores of Gaussians need it). All take the same
tokenizer from the package tokenizers. Wall and processor seconds from the start of the process, peak memory, and
the largest difference of a number from transformers' embeddings. The ways alternate; medians over the repeats,
after one round that fills the caches. Models: the bundled CLIP, and a CLIP of the size of ViT-B/16 with random
weights.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

PHRASES = ("red apple", "something to drink from", "a brown teddy bear", "wooden table")
VOCABULARY = 49_408
"""Words of the large tower's vocabulary, as CLIP's."""


def ours(folder: Path) -> np.ndarray:
    """By our own module over safetensors."""
    from lexsplat.features.clip_text import open_clip_text

    tower = open_clip_text(folder, "benchmark")
    assert tower is not None, "the tower is not whole"
    return tower.encode_text(PHRASES).numpy()


def by_transformers(folder: Path) -> np.ndarray:
    """By transformers' own class."""
    import torch
    from transformers import CLIPTextModelWithProjection

    model = CLIPTextModelWithProjection.from_pretrained(folder).eval()
    with torch.inference_mode():
        tokens, mask = token_rows(folder)
        found = model(input_ids=torch.from_numpy(tokens), attention_mask=torch.from_numpy(mask)).text_embeds
    return unit(found.numpy())


def by_onnx(folder: Path) -> np.ndarray:
    """By ONNX Runtime, without torch."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(folder / "text.onnx", options, providers=["CPUExecutionProvider"])
    tokens, mask = token_rows(folder)
    return unit(session.run(None, {"tokens": tokens, "mask": mask})[0])


def by_onnx_beside_torch(folder: Path) -> np.ndarray:
    """The same in a process that has torch, which the scores of Gaussians need."""
    import torch  # noqa: F401

    return by_onnx(folder)


WAYS: dict[str, Callable[[Path], np.ndarray]] = {
    "ours": ours,
    "transformers": by_transformers,
    "ONNX Runtime": by_onnx,
    "ONNX Runtime and torch": by_onnx_beside_torch,
}


def token_rows(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Token numbers and mask ``[4, T]`` of the phrases, padded to the longest."""
    from tokenizers import Tokenizer

    found = [
        encoded.ids for encoded in Tokenizer.from_file(str(folder / "tokenizer.json")).encode_batch(PHRASES)
    ]
    longest = max(map(len, found))
    tokens = np.array([ids + ids[-1:] * (longest - len(ids)) for ids in found], np.int64)
    mask = np.array([[1] * len(ids) + [0] * (longest - len(ids)) for ids in found], np.int64)
    return tokens, mask


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows of length 1."""
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def child(way: str, folder: Path) -> None:
    """Embed the phrases in one way, and print them with the peak memory of this process."""
    rows = WAYS[way](folder)
    status = Path("/proc/self/status").read_text()  # Linux hands ``ru_maxrss`` on from the process before
    peak = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    print(json.dumps({"rows": rows.tolist(), "megabytes": peak / 1024}))


def model_folders(work: Path) -> dict[str, Path]:
    """Folders of both models, with ``text.onnx`` where it can be exported."""
    from lexsplat.features.hub import model_folder

    small, large = work / "small", work / "large"
    small.mkdir()
    for path in Path(model_folder("bundled", "clip")).iterdir():
        (small / path.name).symlink_to(path)
    write_large(large)
    folders = {"bundled": small, "ViT-B/16": large}
    for folder in folders.values():
        export(folder)
    return folders


def write_large(folder: Path) -> None:
    """A text tower of the size of CLIP ViT-B/16 with random weights, and a tokenizer of words."""
    import torch
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import CLIPConfig, CLIPModel

    words = sorted({word for phrase in PHRASES for word in phrase.split()})
    names = ["<|startoftext|>", *words]
    names += [f"word{number}" for number in range(VOCABULARY - len(names) - 1)] + ["<|endoftext|>"]
    tokenizer = Tokenizer(models.WordLevel({name: number for number, name in enumerate(names)}, names[-2]))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    ends = [(names[0], 0), (names[-1], VOCABULARY - 1)]
    tokenizer.post_processor = processors.TemplateProcessing(
        f"{names[0]} $A {names[-1]}", special_tokens=ends
    )
    torch.manual_seed(0)
    config = CLIPConfig()
    config.text_config.eos_token_id, config.text_config.bos_token_id = VOCABULARY - 1, 0
    CLIPModel(config).save_pretrained(folder)
    tokenizer.save(str(folder / "tokenizer.json"))


def export(folder: Path) -> None:
    """Write ``text.onnx``; says so where packages for it are missing."""
    import torch
    from transformers import CLIPTextModelWithProjection

    model = CLIPTextModelWithProjection.from_pretrained(folder, attn_implementation="eager").eval()

    class Tower(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, tokens: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
            return self.model(input_ids=tokens, attention_mask=mask).text_embeds

    given = tuple(map(torch.from_numpy, token_rows(folder)))
    try:
        import onnxruntime  # noqa: F401

        torch.onnx.export(
            Tower(), given, folder / "text.onnx", dynamo=True, input_names=["tokens", "mask"], verbose=False
        )
    except ImportError as error:
        print(f"ONNX Runtime is not measured: {error}")


def run(way: str, folder: Path) -> dict[str, Any]:
    """One process: what it printed, and its wall and processor seconds."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    cache = {"HF_HUB_OFFLINE": "1", "XDG_CACHE_HOME": str(folder.parent / "cache")}
    environment = {**os.environ, **cache, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, __file__, "--child", way, str(folder)],
        env=environment, check=True, capture_output=True, text=True,
    )  # fmt: skip
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**json.loads(done.stdout.splitlines()[-1]), "wall": wall, "processor": processor}


def measure(name: str, folder: Path, repeats: int) -> list[dict[str, Any]]:
    """A row for each way."""
    ways = [way for way in WAYS if "ONNX" not in way or (folder / "text.onnx").exists()]
    runs: dict[str, list[dict[str, Any]]] = {way: [] for way in ways}
    for number in range(repeats + 1):
        for way in ways:
            found = run(way, folder)
            if number:
                runs[way].append(found)
    exact = np.array(runs["transformers"][0]["rows"])
    rows = []
    for way, found in runs.items():
        row: dict[str, Any] = {"model": name, "way": way}
        row |= {
            key: statistics.median(each[key] for each in found) for key in ("wall", "processor", "megabytes")
        }
        row["difference"] = float(np.abs(np.array(found[0]["rows"]) - exact).max())
        rows.append(row)
    return rows


def main() -> None:
    if sys.argv[1:2] == ["--child"]:
        return child(sys.argv[2], Path(sys.argv[3]))
    from records import argument_parser, write_record  # it imports torch, which one of the ways goes without

    parser = argument_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as work:
        print(f"{'model':<10} {'way':<24} {'wall':>7} {'cpu':>7} {'memory':>9} {'difference':>11}")
        for name, folder in model_folders(Path(work)).items():
            for row in measure(name, folder, options.repeats):
                rows.append(row)
                print(
                    f"{row['model']:<10} {row['way']:<24} {row['wall']:6.2f}s {row['processor']:6.2f}s"
                    f" {row['megabytes']:6.0f} MB {row['difference']:11.1e}",
                    flush=True,
                )
    write_record(options.json, rows, repeats=options.repeats)


if __name__ == "__main__":
    main()
