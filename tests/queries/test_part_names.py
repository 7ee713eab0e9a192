"""Names of parts compared at one place, by hand."""

from __future__ import annotations

import pytest
import torch

from lexsplat.queries.part_names import ALIKE, NAMES, RIVAL, fits_of, is_doubtful

CODES = 4
AT_FIRST = torch.tensor([1.0, 0, 0, 0])


def fits(**named: float) -> torch.Tensor:
    """Fits ``[K, W]`` of names at the first code; all others fit nothing."""
    table = torch.zeros(CODES, len(NAMES))
    for name, value in named.items():
        table[0, NAMES.index(name)] = value
    return table


def test_another_name_makes_a_part_doubtful_from_a_factor_on():
    assert not is_doubtful("eye", AT_FIRST, fits(eye=1.0, nose=0.99 * RIVAL))
    assert is_doubtful("eye", AT_FIRST, fits(eye=1.0, nose=1.01 * RIVAL))
    assert not is_doubtful("nose", AT_FIRST, fits(eye=1.0, nose=1.01 * RIVAL))


@pytest.mark.parametrize(
    ("part", "other"), [("stem", "stalk"), ("wheel", "tire"), ("cap", "cork"), ("head", "face")]
)
def test_of_two_names_of_one_part_the_better_one_counts(part, other):
    assert not is_doubtful(part, AT_FIRST, fits(**{part: 0.1, other: 1.0, "handle": 1.1}))
    assert is_doubtful(part, AT_FIRST, fits(**{part: 0.1, other: 1.0, "handle": 1.2}))


def test_every_name_that_is_alike_is_compared():
    assert {name for group in ALIKE for name in group} <= set(NAMES)


def test_what_fits_nothing_is_doubtful_where_anything_fits():
    assert is_doubtful("eye", AT_FIRST, fits(eye=-1.0, nose=0.1))
    assert not is_doubtful("eye", AT_FIRST, fits(eye=-1.0, nose=-0.1))


def test_a_fit_is_the_geometric_mean_of_the_height_and_its_share_of_the_best():
    heights = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    best = heights.sort(dim=0, descending=True).values[:2].mean(0)  # of 50 codes, 4 percent
    assert torch.allclose(fits_of(heights), (heights * heights / best).sqrt())


def test_a_place_is_the_mean_of_its_codes():
    table = torch.zeros(CODES, len(NAMES))
    table[0, NAMES.index("eye")], table[1, NAMES.index("nose")] = 1.0, 1.0
    assert not is_doubtful("eye", torch.tensor([0.5, 0.5, 0, 0]), table)
    assert is_doubtful("eye", torch.tensor([0.4, 0.6, 0, 0]), table)
