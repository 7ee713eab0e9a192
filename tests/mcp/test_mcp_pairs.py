"""`measure` and `nearest`: the two ends are different things, and the answer tells which were taken of several."""

import numpy as np
import pytest

pytest.importorskip("mcp")
from mcp.server import MCPServer
from support.mcp_clients import ask

from lexsplat import open_scene
from lexsplat.mcp.server import make_server
from lexsplat.scenes.serving import open_scenes


@pytest.fixture(scope="module")
def server() -> MCPServer:
    return make_server(open_scenes(["demo"]))


@pytest.fixture(scope="module")
def points_of_things():
    """The points of things of the bundled scene, by name."""
    scene = open_scene("demo")
    names = ("apple", "banana", "teddy bear", "toy car", "rubber duck")
    return {name: scene.find(name).selected.means.detach().double().numpy() for name in names}


def gap(first, second):
    """The smallest distance of two sets of points without strays, by loops in float64."""
    ways = (first, second), (second, first)
    nearest = [[float(np.sqrt(((b - point) ** 2).sum(1)).min()) for point in a] for a, b in ways]
    return max(float(np.quantile(each, 0.002)) for each in nearest)


def names(document):
    return {document["first"]["name"], document["second"]["name"]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second", "ends"),
    [
        ("apple", "fruit", {"apple", "banana"}),
        ("fruit", "apple", {"apple", "banana"}),
        ("fruit", "fruit", {"apple", "banana"}),
        ("toy", "teddy bear", {"teddy bear", "rubber duck"}),
    ],
)
def test_a_thing_is_not_measured_against_itself_but_against_the_nearest_other(
    server, points_of_things, first, second, ends
):
    reply, text = ask(server, "measure", first=first, second=second)
    document = reply.structured_content
    if "teddy bear" in ends:  # which toy is nearer to the bear follows from the points
        toys = ("toy car", "rubber duck")
        ends = {
            "teddy bear",
            min(toys, key=lambda toy: gap(points_of_things["teddy bear"], points_of_things[toy])),
        }
    assert names(document) == ends
    assert document["centers"]["units"] > 0.3
    assert document["gap"]["units"] == pytest.approx(
        gap(*(points_of_things[name] for name in ends)), abs=0.05
    )
    taken = next(iter(ends - {first, second}))
    assert taken in document["note"]
    assert document["note"] in text


@pytest.mark.slow
def test_of_several_things_the_nearest_pair_is_measured_and_named(server, points_of_things):
    reply, text = ask(server, "measure", first="fruit", second="toy")
    document = reply.structured_content
    pairs = [(a, b) for a in ("apple", "banana") for b in ("teddy bear", "toy car", "rubber duck")]
    nearest = min(pairs, key=lambda pair: gap(points_of_things[pair[0]], points_of_things[pair[1]]))
    assert (document["first"]["name"], document["second"]["name"]) == nearest
    assert document["note"] == (
        f'"fruit" fits 2 and "toy" fits 3 things; measured is the nearest pair, {nearest[0]} and {nearest[1]}'
    )
    assert document["note"] in text
    note = ask(server, "measure", first="mug", second="toy")[0].structured_content["note"]
    assert note.startswith('"toy" fits 3 things; measured is the nearest pair, mug and ')
    assert ask(server, "measure", first="apple", second="mug")[0].structured_content["note"] == ""


@pytest.mark.parametrize("pair", [("apple", "apple"), ("duck", "rubber duck")])
def test_one_thing_alone_has_no_distance(server, pair):
    reply, text = ask(server, "measure", first=pair[0], second=pair[1])
    assert reply.is_error
    assert "one thing" in text
    assert reply.structured_content["error"]["remedy"]


@pytest.mark.slow
def test_a_thing_is_nearest_to_another_of_the_kind_that_it_is_of(server, points_of_things):
    for target, to in (("apple", "fruit"), ("fruit", "apple"), ("fruit", "fruit")):
        reply, text = ask(server, "nearest", target=target, to=to)
        document = reply.structured_content
        assert {document["nearest"]["name"], document["to"]["name"]} == {"apple", "banana"}, text
        assert document["distance"]["units"] == pytest.approx(
            gap(points_of_things["apple"], points_of_things["banana"]), abs=0.05
        )
    reply, text = ask(server, "nearest", target="fruit", to="apple")
    assert text.startswith("banana is nearest to apple: ")
    assert 'the only other one for "fruit"' in text
    assert ask(server, "nearest", target="apple", to="fruit")[1].startswith("apple is nearest to banana: ")


def test_the_thing_that_the_nearest_is_nearest_to_is_named(server):
    reply, text = ask(server, "nearest", target="mug", to="toy")
    document = reply.structured_content
    assert document["to"]["name"] in ("teddy bear", "toy car", "rubber duck")
    assert f'"toy" fits 3 things; taken is the nearest one, {document["to"]["name"]}' == document["note"]
    assert document["note"] in text
    reply, text = ask(server, "nearest", target="thing", to="lamp")
    assert (reply.structured_content["among"], reply.structured_content["note"]) == (13, "")
    assert "of 13 for any object" in text
    point = ask(server, "nearest", target="fruit", point=[-0.5, -1.3, 0.2])[0].structured_content
    assert (point["to"], point["among"]) == (None, 2)
