"""Cost of a prompt in a view after the language is rendered, compared with the published algorithm.

The published algorithm (LERF's relevancy on the paper's feature map) computes F = p S for each pixel, normalizes it,
compares it with the prompt and each canonical phrase, takes a softmax of each pair and keeps the minimum. ``feature``
computes the same without F (difference below 1e-5), ``code`` blends the relevancies of the codes, and ``gaussians``
scores 200,000 Gaussians with four codes each. All receive the same code probabilities p, codebook and texts. Memory
is the growth of the process's peak beyond p.

    python benchmarks/query.py                       # 480x360, K = 32, 128, 256
    python benchmarks/query.py --sizes 480x360 1297x840 --prompts 1 14
"""

from __future__ import annotations

import multiprocessing
import resource
import statistics
import time

import torch
from records import argument_parser, write_record

from lexsplat.queries.relevancy import QueryConfig, Question, code_relevancy, probability_relevancy

DIMENSION = 512
METHODS = ("published", "feature", "code", "gaussians")


def published(probabilities, codewords, positives, negatives, temperature=10.0):
    """The full feature map, a softmax against each negative, prompt by prompt: ``[H, W, P]``."""
    features = probabilities @ codewords
    features = features / features.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    maps = []
    for positive in positives:
        cosine = features @ positive
        pairs = [
            torch.softmax(temperature * torch.stack([cosine, features @ negative], dim=-1), dim=-1)[..., 0]
            for negative in negatives
        ]
        maps.append(torch.stack(pairs).amin(0))
    return torch.stack(maps, dim=-1)


def make_inputs(width, height, codes, prompts):
    generator = torch.Generator().manual_seed(0)
    probabilities = torch.empty(height, width, codes)
    for row in probabilities:  # in place: a second copy would raise the peak and hide the measured growth
        torch.softmax(3 * torch.randn(width, codes, generator=generator), dim=-1, out=row)
    codewords, positives, negatives = (
        torch.nn.functional.normalize(torch.randn(count, DIMENSION, generator=generator), dim=-1)
        for count in (codes, prompts, 4)
    )
    return probabilities, codewords, positives, negatives


def sparse_scores(codes, weights, table):
    """Scores of Gaussians that carry four codes each, as `CodeField.scores` computes them."""
    total = weights.new_zeros(len(codes), table.shape[1])
    for column in range(codes.shape[1]):
        total.addcmul_(weights[:, column, None], table[codes[:, column]])
    return total


def measure(connection, method, width, height, codes, prompts, repeats, threads):
    torch.set_num_threads(threads)
    probabilities, codewords, positives, negatives = make_inputs(width, height, codes, prompts)
    question = Question(positives, negatives, QueryConfig(form="feature" if method == "feature" else "code"))
    if method == "published":
        work = lambda: published(probabilities, codewords, positives, negatives)  # noqa: E731
    elif method == "gaussians":
        count = 200_000
        index = torch.randint(0, codes, (count, 4))
        weights = torch.rand(count, 4)
        work = lambda: sparse_scores(index, weights, code_relevancy(codewords, question))  # noqa: E731
    else:
        work = lambda: probability_relevancy(probabilities, codewords, question)  # noqa: E731
    small = make_inputs(16, 16, codes, prompts)
    (
        published(*small),
        probability_relevancy(*small[:2], Question(*small[2:])),
    )  # libraries allocate at their first call
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result = work()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    error = None
    if method == "feature":
        rows = probabilities[:: max(1, height // 16)]
        reference = published(rows.double(), codewords.double(), positives.double(), negatives.double())
        error = float((result[:: max(1, height // 16)] - reference).abs().max())
    connection.send((1e3 * statistics.median(times) / prompts, grown / 1024, error))


def run(*arguments):
    """One measurement in a new process: the peak memory of a process cannot be reset."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=measure, args=(sender, *arguments))
    process.start()
    sender.close()
    try:
        return receiver.recv()
    except EOFError:
        return None  # killed, most likely out of memory
    finally:
        process.join()


def main():
    parser = argument_parser(__doc__)
    parser.add_argument("--sizes", nargs="+", default=["480x360"])
    parser.add_argument("--codes", nargs="+", type=int, default=[32, 128, 256])
    parser.add_argument("--prompts", nargs="+", type=int, default=[1])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    rows = []
    print(f"torch {torch.__version__}, {options.threads} threads, D = {DIMENSION}")
    print(
        f"{'size':>10}{'K':>5}{'prompts':>9}{'method':>11}{'ms/prompt':>11}{'faster':>8}{'MB':>8}{'less':>7}"
    )
    for size in options.sizes:
        width, height = map(int, size.split("x"))
        for codes in options.codes:
            for prompts in options.prompts:
                base = None
                for method in METHODS:
                    found = run(method, width, height, codes, prompts, options.repeats, options.threads)
                    base = base or found
                    row = {"size": size, "codes": codes, "prompts": prompts, "method": method}
                    if found is not None:
                        row |= {"ms": found[0], "megabytes": found[1], "error": found[2]}
                    rows.append(row)
                    print(describe(row, base), flush=True)
    write_record(options.json, rows, threads=options.threads)


def describe(row, base):
    head = f"{row['size']:>10}{row['codes']:>5}{row['prompts']:>9}{row['method']:>11}"
    if "ms" not in row:
        return f"{head}   did not finish"
    faster = f"{base[0] / row['ms']:.1f}x" if base else ""
    less = f"{base[1] / max(row['megabytes'], 0.1):.0f}x" if base else ""
    text = f"{head}{row['ms']:>11.1f}{faster:>8}{row['megabytes']:>8.0f}{less:>7}"
    return text + (f"   differs by {row['error']:.0e}" if row["error"] is not None else "")


if __name__ == "__main__":
    main()
