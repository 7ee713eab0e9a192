"""Objects from segments: the language of segments, and which of them one name describes as a whole."""

import numpy as np
import pytest
import torch

from lexsplat.language.segment_codes import SegmentCodes, segment_codes
from lexsplat.language.segments import Segments
from lexsplat.queries.colors import (
    COLOR_WORDS,
    METALS,
    NEAR,
    cielab,
    color_told,
    color_words,
    colors_expected,
    may_be,
)
from lexsplat.queries.objects import (
    WholeSegments,
    likeliest_things,
    name_probabilities,
    pieces_of_others,
    surface_fits_better,
    whole_segments,
    with_surfaces,
)

LEVELS = torch.tensor([[0, 1, 2, 3, 4], [0, 0, 1, 2, 3], [0, 0, 1, 2, 2]])


def test_segments_have_the_mean_language_of_their_gaussians_and_each_has_one_number():
    generator = torch.Generator().manual_seed(0)
    labels = torch.randint(0, 5, (200,), generator=generator)
    probabilities, masses = torch.rand(200, 7, generator=generator), torch.rand(200, generator=generator)
    sums = torch.zeros(5, 7).index_add_(0, labels, probabilities * masses[:, None])
    found = segment_codes(Segments(labels, masses, LEVELS), sums.double().numpy())
    assert len(found.masses) == 5 + 1 + 1, "two merges make two new segments"
    for numbers, level in zip(found.numbers, LEVELS.numpy()):
        for segment in np.unique(level):
            (number,) = np.unique(numbers[level == segment])
            members = torch.from_numpy(level == segment)[labels]
            expected = (probabilities * masses[:, None])[members].sum(0) / masses[members].sum()
            torch.testing.assert_close(found.distributions[number], expected)
            assert found.masses[number] == pytest.approx(float(masses[members].sum()))


def codes_of(masses) -> SegmentCodes:
    """The segments of `LEVELS`: 5 is the union of 0 and 1, and 6 that of 3 and 4."""
    numbers = np.array([[0, 1, 2, 3, 4], [5, 5, 2, 3, 4], [5, 5, 2, 6, 6]])
    whole = [*masses, masses[0] + masses[1], masses[3] + masses[4]]
    return SegmentCodes(numbers, torch.zeros(7, 1), np.array(whole, float))


def wholes(strengths, masses=(1, 1, 1, 1, 1), materials=(False, False, False, False)):
    table = np.array(strengths, float)
    return whole_segments(codes_of(masses), lambda part: table[:, part], materials[: table.shape[1]])


def test_the_coarsest_segment_that_a_name_describes_with_its_parts_is_an_object():
    #            mug  nose bear
    strengths = [[0.8, 0.1, 0.1], [0.7, 0.1, 0.1], [0.1, 0.1, 0.1], [0.1, 0.9, 0.5], [0.1, 0.1, 0.9],
                 [0.9, 0.1, 0.1], [0.1, 0.2, 0.9]]  # fmt: skip
    found = wholes(strengths)
    assert found.places.tolist() == [5, 5, -1, 6, 6]
    assert found.words[[5, 6]].tolist() == [0, 2]


def test_a_segment_of_two_things_is_divided():
    strengths = [[0.9, 0.1], [0.1, 0.9], [0.1, 0.1], [0.9, 0.1], [0.1, 0.4], [0.7, 0.2], [0.7, 0.2]]
    assert wholes(strengths).places.tolist() == [0, 1, -1, 3, -1]
    assert wholes(strengths, (9, 1, 1, 9, 1)).places.tolist() == [5, 5, -1, 6, 6], "by what the views show"


def test_what_is_of_metal_is_named_by_what_it_is_where_a_name_fits():
    #            ring metal
    strengths = [[0.7, 0.9], [0.7, 0.9], [0.1, 0.9], [0.1, 0.1], [0.5, 0.9], [0.7, 0.9], [0.1, 0.1]]
    found = wholes(strengths, materials=(False, True))
    assert found.places.tolist() == [5, 5, 2, -1, 4]
    assert found.words[[5, 2, 4]].tolist() == [0, 1, 1]


def test_probabilities_of_names_leave_a_rest_for_other_names():
    shares = name_probabilities(np.array([0.9, 0.8, 0.1]))
    assert shares[0] > shares[1] > shares[2] > 0
    assert shares[0] / shares[1] == pytest.approx(np.exp(12 * 0.1))
    assert shares.sum() < 1
    assert name_probabilities(np.full(3, 0.1)).sum() < 0.01


@pytest.mark.parametrize(
    ("colors", "weights", "words"),
    [
        ([[0.7, 0.1, 0.1]], [1], ["red"]),
        ([[0.35, 0.05, 0.05]], [1], ["red"]),
        ([[0.95, 0.95, 0.95], [0.05, 0.05, 0.05]], [2, 1], ["white", "black"]),
        ([[0.1, 0.2, 0.7], [0.9, 0.8, 0.2]], [9, 1], ["blue"]),
    ],
)
def test_colors_are_named_by_the_weight_that_shows_them(colors, weights, words):
    assert color_words(np.array(colors), np.array(weights, float)) == words


@pytest.mark.parametrize(
    ("word", "names"),
    [
        ("blue", "#0000ff #000080 #00004d #3366e6 #87ceeb #1e90ff #4682b4 #00ffff #0080ff"),
        ("green", "#00ff00 #008000 #90ee90 #6b8e23 #2e8b57 #008080"),
        ("purple", "#800080 #8a2be2 #4b0082 #9966cc #ee82ee"),
        ("red", "#ff0000 #800000 #dc143c #cd5c5c"),
        ("yellow", "#ffff00 #ffd700 #f0e68c"),
        ("orange", "#ffa500 #ff8c00"),
        ("pink", "#ffc0cb #ff69b4 #ff1493"),
        ("brown", "#8b4513 #5c4033"),
        ("white", "#ffffff #f5f5f5 #fffff0"),
        ("gray", "#808080 #696969 #708090"),
        ("black", "#000000 #101010"),
    ],
)
def test_well_known_colors_have_their_names(word, names):
    """Names of CSS, such as navy, sky blue, cyan, teal, indigo, crimson, gold and slate gray."""
    for name in names.split():
        color = [int(name[place : place + 2], 16) / 255 for place in (1, 3, 5)]
        assert color_words(np.array([color]), np.ones(1)) == [word], name


def test_cielab_is_that_of_scikit_image():
    rgb2lab = pytest.importorskip("skimage.color").rgb2lab
    colors = np.concatenate([np.random.default_rng(0).random((500, 3)), np.eye(3), [[0, 0, 0], [1, 1, 1]]])
    np.testing.assert_allclose(cielab(colors), rgb2lab(colors), atol=1e-3)


def test_a_thing_may_have_a_color_that_light_or_shade_turns_into_another_one():
    assert {word for pair in NEAR for word in pair.split()} == set(COLOR_WORDS)
    assert may_be({"white"}, {"gray"})
    assert may_be({"gray"}, {"red", "white"})
    assert not may_be({"blue"}, {"brown", "white"})
    assert not may_be({"yellow"}, {"red"})
    assert (color_told("Grey mug"), color_told("orange"), color_told("red and white cloth")) == (
        {"gray"}, set(), {"red", "white"},
    )  # fmt: skip


def test_a_thing_of_metal_is_seen_in_the_colors_of_the_metal():
    assert {word for colors in METALS.values() for word in colors.split()} <= set(COLOR_WORDS)
    assert colors_expected("Golden ring") == colors_expected("gold ring") == {"yellow", "orange", "brown"}
    assert colors_expected("red and silver ball") == {"red", "gray", "white"}
    assert colors_expected("gold") == colors_expected("ring") == set(), "the thing itself has no color told"
    assert color_told("gold ring") == set(), "not every yellow ring is of gold"


def test_a_segment_of_a_surface_that_a_thing_names_better_may_be_its_piece():
    #            table lamp
    strengths = [[0.9, 0.1], [0.1, 0.9], [0.1, 0.1], [0.1, 0.9], [0.1, 0.9], [0.9, 0.2], [0.1, 0.9]]
    whole, lowest = wholes(strengths, (9, 1, 1, 1, 1)), np.arange(5)
    assert whole.places.tolist() == [5, 5, -1, 6, 6]
    table, known = np.array(strengths), np.array([0, 1])
    surfaces = np.array([True, False])
    assert pieces_of_others(whole, lowest, known, table, surfaces).tolist() == [-1, 1, -1, -1, -1]
    assert pieces_of_others(whole, lowest, known, table, ~surfaces).tolist() == [-1] * 5, "the lamp is a lamp"
    table[1] = 0.6, 0.9
    assert pieces_of_others(whole, lowest, known, table, surfaces)[1] == 1, (
        "the lamp's name fits clearly better"
    )
    table[1] = 0.7, 0.9
    assert (pieces_of_others(whole, lowest, known, table, surfaces) < 0).all(), "the table's name fits, too"
    table[1] = 0.1, 0.5
    assert (pieces_of_others(whole, lowest, known, table, surfaces) < 0).all(), "no name fits"


def test_the_likeliest_thing_needs_half_and_is_no_surface():
    #                              table lamp mug
    strengths = np.array([[0.9, 0.6, 0.55], [0.9, 0.4, 0.5], [0.2, 0.49, 0.3], [0.2, 0.1, 0.1]])
    known, surfaces = np.array([3, 5, 8]), np.array([True, False, False])
    lowest = np.array([0, 1, 2, 3, 1])
    assert likeliest_things(lowest, known, strengths, surfaces).tolist() == [5, 8, -1, -1, 8]
    assert likeliest_things(lowest, known, strengths, np.ones(3, bool)).tolist() == [-1] * 5


def test_a_surface_fits_better_where_its_name_is_clearly_stronger_than_that_of_each_object():
    #                              table lamp mug
    strengths = np.array([[0.9, 0.6, 0.7], [0.5, 0.6, 0.2], [0.0, 0.0, 0.0]])
    surfaces, lowest = np.array([True, False, False]), np.array([1, 0, 0, 2])
    expected = [[False, False, True], [False, True, False], [False, True, False], [False] * 3]
    assert surface_fits_better(lowest, strengths, surfaces).tolist() == expected
    assert not surface_fits_better(lowest, strengths, np.zeros(3, bool)).any(), "no surface is known"


def names_with_surfaces(strengths, words, masses, surfaces) -> list[int]:
    """The words of objects of one lowest segment each, with surfaces named."""
    table, own = np.array(strengths, float), np.array(words)
    whole = WholeSegments(np.arange(len(own)), own, table[np.arange(len(own)), own])
    found = with_surfaces(whole, np.array(masses, float), np.array(surfaces, int), table[:, surfaces])
    assert found.places.tolist() == whole.places.tolist()
    return found.words.tolist()


def test_a_floor_that_resembles_a_thing_nearly_as_much_is_the_floor():
    #            floor whisk mug
    strengths = [[0.98, 0.90, 0.1], [0.98, 0.99, 0.1], [0.2, 0.3, 0.9]]
    assert names_with_surfaces(strengths, [0, 1, 2], [5, 1, 1], [0]) == [0, 0, 2]
    assert names_with_surfaces(strengths[1:], [1, 2], [1, 1], [0]) == [0, 2], "one piece alone"
    strengths[1][1] = 1.05
    assert names_with_surfaces(strengths, [0, 1, 2], [5, 1, 1], [0]) == [0, 1, 2], "less than half as likely"


def test_a_thing_on_a_table_that_no_word_describes_well_is_not_the_table():
    #            table ring
    strengths = [[0.95, 0.1], [0.745, 0.75]]
    assert names_with_surfaces(strengths, [0, 1], [5, 1], [0]) == [0, 1]


def test_names_of_surfaces_that_are_alike_at_each_other_are_one_name():
    #            table desk wall
    strengths = [[0.95, 0.94, 0.1], [0.86, 0.87, 0.1], [0.66, 0.67, 0.2], [0.1, 0.2, 0.9]]
    assert names_with_surfaces(strengths, [0, 1, 1, 2], [9, 2, 1, 5], [0, 1, 2]) == [0, 0, 0, 2]
    assert names_with_surfaces(strengths, [0, 1, 1, 2], [2, 9, 1, 5], [0, 1, 2]) == [1, 1, 1, 2], (
        "most is a desk"
    )
    strengths[0][1] = 0.5
    assert names_with_surfaces(strengths, [0, 1, 1, 2], [9, 2, 1, 5], [0, 1, 2]) == [0, 1, 1, 2], (
        "the desk may be a table, but the table is no desk"
    )
    strengths[0][1], strengths[1][0] = 0.94, 0.5
    assert names_with_surfaces(strengths, [0, 1, 1, 2], [9, 2, 1, 5], [0, 1, 2]) == [0, 1, 1, 2], (
        "most of the desk is no table"
    )
