"""Tools for language models. Each function returns one sentence and the same JSON as the commands.

The model reads the docstrings and type hints: `lexsplat.mcp.server` makes descriptions and schemas of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from lexsplat.mcp import answers
from lexsplat.mcp.arguments import NOT_BLANK, nearest
from lexsplat.mcp.pictures import picture
from lexsplat.queries.patterns import VIEWER
from lexsplat.queries.phrases import Related, RelationName, Understood, Viewer
from lexsplat.queries.places import UNITS
from lexsplat.runtime.errors import LexsplatError, QueryError
from lexsplat.scenes.answers import find_phrases
from lexsplat.scenes.asked import both, certainty, joined, things_of
from lexsplat.scenes.finding import find_in
from lexsplat.scenes.library import Library
from lexsplat.scenes.measuring import in_words, length_of, measure, measured_sentence
from lexsplat.scenes.objects import list_document
from lexsplat.scenes.pairs import called, different, others, view_of
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.serving import MAX_LINE, OpenScene, counted, placed, qualified, sentence, shortened
from lexsplat.scenes.unsaved import unsaved_steps

SceneName = Annotated[str, Field(description="Name from list_scenes; may be left out if there is one scene.")]
PhraseText = Annotated[
    str,
    Field(
        description='Free text, such as "red apple", "what is on the table?" or "mug left of the lamp".',
        pattern=NOT_BLANK,
        max_length=MAX_LINE,
    ),
]
ViewName = Annotated[
    str, Field(description="Name of a view (a photo): what left, right and me refer to; may be empty.")
]
_FARTHEST = 1e9
"""Largest coordinate of a point, in scene units."""
_LISTED = 100
"""Scenes of a library that are listed, at most."""


class Reply(NamedTuple):
    """Answer of a tool: a sentence, plain data, and for `Tools.render` a PNG."""

    sentence: str
    document: dict[str, Any]
    image: bytes | None = None


class Tools:
    """The read-only tools.

    Args:
        scenes: The served scenes by name.
        library: A library whose scenes are served as well.
    """

    def __init__(self, scenes: Mapping[str, OpenScene], library: Library | None = None) -> None:
        self.scenes, self.library = scenes, library
        self._given = list(scenes)  # an edit adds others

    def list_scenes(self) -> Annotated[Reply, answers.ScenesAnswer]:
        """List the places that can be searched."""
        listed = [{"name": name, **_facts_or_problem(served)} for name, served in self.scenes.items()]
        document: dict[str, Any] = {"scenes": listed}
        names = [f"{each['name']}{_remark(each)}" for each in listed]
        text = f"{counted(len(listed), 'scene')}: {', '.join(names)}." if listed or not self.library else ""
        if self.library is not None:
            try:
                names = self.library.names()
            except LexsplatError as error:
                if not listed:
                    raise
                document["library"] = {"problem": str(error)}
                return Reply(f"{text} A library that cannot be asked ({error}).", document)
            document["library"] = {"scenes": len(names), "names": names[:_LISTED]}
            text = (
                f"{text} A library of {counted(len(names), 'scene')}: {', '.join(names[:_LISTED])}.".strip()
            )
        return Reply(text, document)

    def describe_scene(self, scene: SceneName = "") -> Annotated[Reply, answers.SceneAnswer]:
        """Describe a place: its size, its up direction, its unit of length, its views and the things it holds."""
        place = self._scene(scene)
        low, high = np.quantile(place.gaussians.means.detach().cpu().numpy(), (0.01, 0.99), axis=0)
        names = [thing.phrase for thing in place.objects]
        document = {
            **_facts(place),
            **place.world.to_json(),
            "extent": [[round(float(v), 4) for v in corner] for corner in (low, high)],
            "view_names": list(place.views),
            "things": names,
            "encoder": place.encoder_identity(),
        }
        unit = place.world.meters_per_unit
        scale = f"one unit is {unit:.3g} m" if unit else "the length of a unit in meters is unknown"
        return Reply(f"{counted(len(names), 'known thing')}: {', '.join(names)}; {scale}.", document)

    def list_objects(self, scene: SceneName = "") -> Annotated[Reply, answers.ListAnswer]:
        """List everything that a place holds, with names, colors, places and sizes."""
        document = list_document(self._scene(scene))
        named = (f"{' '.join(thing['colors'])} {thing['name']}" for thing in document["objects"])
        return Reply(f"{counted(len(document['objects']), 'object')}: {', '.join(named)}.", document)

    def find(
        self,
        phrase: PhraseText,
        scene: SceneName = "",
        view: ViewName = "",
        threshold: Annotated[
            float | None, Field(description="Relevancy in 0..1; chosen by itself if left out.")
        ] = None,
    ) -> Annotated[Reply, answers.FindAnswer]:
        """Find things by words: where they are, how large, how many, best view; "present": "no" means not here."""
        place = self._scene(scene)
        document = find_phrases(place, phrase, view or None, threshold)
        return Reply(sentence(document["phrases"][0]), document)

    def count(self, phrase: PhraseText, scene: SceneName = "") -> Annotated[Reply, answers.Counted]:
        """Count things by words, such as "apples" or "toys on the table"."""
        found = self.find(phrase, scene).document
        (answer,) = found["phrases"]
        document = {
            key: value
            for key, value in {**found, **answer}.items()
            if key in answers.Counted.__required_keys__
        }
        if not answer["count"]:
            return Reply(sentence(answer), document)
        return Reply(
            qualified(f"{answer['count']} found for {shortened(answer['understood'])}.", document), document
        )

    def relate(
        self,
        first: PhraseText,
        relation: Annotated[RelationName, Field(description="How the first stands to the second.")],
        second: PhraseText,
        scene: SceneName = "",
        view: ViewName = "",
    ) -> Annotated[Reply, answers.RelateAnswer]:
        """Tell whether things stand in a relation to others, and which do. Left and right are those of the view."""
        place = self._scene(scene)
        viewer = VIEWER.match(second.strip())
        pair = place.understand(first), Understood(Viewer()) if viewer else place.understand(second)
        related = Related(relation, pair[0].phrase, pair[1].phrase)
        unknown, unread = (any(getattr(each, name) for each in pair) for name in ("unknown", "unread"))
        asked = Understood(related, "", unknown, unread)
        found = find_in(place, asked, place.camera(view) if view else None, None)
        holds = {"yes": "Yes", "unsure": "Perhaps", "no": "No"}[found.present]
        answer = {
            **place.world.to_json(),
            **found.to_dict(),
            "understood": str(related),
            "note": joined(pair[0].note, pair[1].note, found.note),
            "holds": holds.lower(),
            "seen_from": found.seen_from or None,
        }
        text = sentence(answer)
        if found.present == "no":
            text = text.replace("Not here", "No", 1)
        elif found.present == "yes":
            text = f"Yes: {text}"
        return Reply(text, answer)

    def nearest(
        self,
        target: PhraseText,
        to: Annotated[
            str,
            Field(
                description="What the target is nearest to, in words; left out if a point is given.",
                max_length=MAX_LINE,
            ),
        ] = "",
        point: Annotated[
            list[float], Field(description="A point x, y, z in scene units in place of words.")
        ] = [],  # noqa: B006
        scene: SceneName = "",
    ) -> Annotated[Reply, answers.NearestAnswer]:
        """Find which of several things is nearest to another thing or to a point, and how far away it is."""
        _one_of({"to": to.strip(), "point": point})
        place = self._scene(scene)
        things, asked = things_of(place, target)
        understood = shortened(asked["understood"])
        if point:
            goal = np.array(point, dtype=float)
            if goal.shape != (3,) or not (np.abs(goal) <= _FARTHEST).all():
                expected = f"three finite numbers, none beyond {_FARTHEST:g}"
                raise QueryError("point", expected=expected, found=repr(point)[:60])
            best = min(things, key=lambda one: float(np.linalg.norm(one.center - goal)))
            gap = float(np.linalg.norm(best.center - goal))
            where, end, candidates = f"({', '.join(f'{value:.2f}' for value in point)}) {UNITS}", None, things
        else:
            ends, reference = things_of(place, to)
            candidates = others(things, ends) or things
            gap, best, end = different(candidates, ends, target[:60])
            asked = both(asked, reference, "nearest to", view_of(best, end))
            where = called(end, ends)
            if len(ends) > 1:
                fits = f"{shortened(reference['understood'])} fits {len(ends)} things"
                asked["note"] = joined(asked["note"], f"{fits}; taken is the nearest one, {where}")
        document = {
            **place.world.to_json(),
            **asked,
            "distance": length_of(place.world, gap),
            "nearest": best.geometry(),
            "to": end.geometry() if end else None,
            "among": len(candidates),
        }
        only = f"the only {'other ' if len(things) > 1 else ''}one for {understood}"
        among = only if len(candidates) == 1 else f"of {len(candidates)} for {understood}"
        text = f"{called(best, things)} is nearest to {where}: {in_words(length_of(place.world, gap))} away, {among}."
        return Reply(qualified(text, asked), document)

    def measure(
        self, first: PhraseText, second: PhraseText, scene: SceneName = ""
    ) -> Annotated[Reply, answers.MeasureAnswer]:
        """Measure between two things: center to center, the gap between their surfaces, the difference in height."""
        place = self._scene(scene)
        document = measure(place, first, second)
        return Reply(measured_sentence(document), document)

    def what_is_at(
        self,
        view: Annotated[str, Field(description="Name of a view.")],
        x: Annotated[float, Field(description="Pixels from the left.")],
        y: Annotated[float, Field(description="Pixels from the top.")],
        scene: SceneName = "",
    ) -> Annotated[Reply, answers.PixelAnswer]:
        """Tell what a pixel of a view shows: the name of the thing, its place and its size."""
        place = self._scene(scene)
        hit = place.click(view, x, y)
        shares = [
            (int((hit.mask & thing.mask).sum()) / max(1, min(len(hit), len(thing))), thing)
            for thing in place.objects
        ]
        share, best = max(shares, key=lambda entry: entry[0], default=(0.0, hit))
        name = best.phrase if share > 0.3 else ""
        shown = best if name else hit
        document = {
            **place.world.to_json(),
            **certainty(shown),
            "name": name,
            "view": view,
            "x": x,
            "y": y,
            "surface": hit.geometry(),
            "thing": best.geometry() if name else None,
        }
        named = {**shown.geometry(), "name": name or "something without a known name"}
        there = placed(named, " is there, at ")
        return Reply(qualified(f"{there}.", document), document)

    def render(
        self,
        view: ViewName = "",
        look_at: Annotated[
            str,
            Field(
                description="A phrase in place of a view: the view that shows it best.", max_length=MAX_LINE
            ),
        ] = "",
        phrases: Annotated[
            list[PhraseText],
            Field(description="Up to 4 phrases whose relevancy is drawn as heat.", max_length=4),
        ] = [],  # noqa: B006
        scene: SceneName = "",
    ) -> Annotated[Reply, answers.RenderAnswer]:
        """Show an image of a place: a view, or the view that shows a thing best; with a heatmap for each phrase."""
        if view or look_at:
            _one_of({"view": view, "look_at": look_at})
        place = self._scene(scene)
        name = place.view(view).name if view else ""
        looked_at = None
        if look_at:
            (best, *_), looked_at = things_of(place, look_at)
            name = best.best_view
        name = name or next(iter(place.views))
        legend, png = picture(place, name, phrases)
        document = {**place.world.to_json(), "view": name, "look_at": looked_at, "legend": legend}
        shown = f"{name} shows {shortened(looked_at['understood'])} best." if looked_at else f"{name}."
        heat = (
            f"Heat for {each['understood']}: present {each['present']}, peak {each['peak']}."
            + (f" Note: {each['note']}." if each["note"] else "")
            for each in legend
        )
        text = qualified(shown, looked_at) if looked_at else shown
        return Reply(" ".join((text, *heat)), document, png)

    def _scene(self, name: str) -> Scene:
        if not name and len(self._given) == 1:
            name = self._given[0]
        if name not in self.scenes:
            kept = self.library.names() if self.library is not None else []
            known = [*self.scenes, *kept]
            if not name and not self._given and len(kept) == 1:
                name = kept[0]
            if self.library is not None and name in kept:
                return self.library.scene(name)
            raise QueryError(
                f"scene {name[:60]!r}" if name else "scene",
                expected=f"one of {', '.join(known)[:200]}",
                found="no such name" if name else "none",
                remedy=nearest(name, known, "list_scenes has the names"),
            )
        return self.scenes[name].scene


class LibraryTools(Tools):
    """The read-only tools, and the search over all scenes of a library."""

    def search_library(
        self,
        phrase: PhraseText,
        limit: Annotated[int, Field(description="Number of scenes, at most.", ge=1, le=50)] = 5,
    ) -> Annotated[Reply, answers.LibraryAnswer]:
        """Find which of many places hold a thing, and where in them; their names work in all other tools."""
        if self.library is None:
            raise ValueError("there is no library")
        found = self.library.search(phrase, limit)
        if found.hits:
            listed = "; ".join(hit.without_note() for hit in found.hits)
            text = f"In {len(found.hits)} of {counted(found.scenes, 'scene')}: {listed}"
        elif not found.scenes and not found.skipped:
            text = "The library holds no scene."
        else:
            unasked = found.present == "unsure" and (found.skipped or found.unopened)
            where = "no scene that could be asked" if unasked else "no scene"
            text = f"In {where}: nothing fits {shortened(found.understood)}."
        note = f" Note: {found.note}." if found.note else ""
        more = f" {counted(found.unopened, 'more scene')} may hold it." if found.unopened else ""
        skipped = f" {counted(len(found.skipped), 'scene')} could not be asked." if found.skipped else ""
        return Reply(text + note + more + skipped, found.to_dict())


def _one_of(arguments: dict[str, Any]) -> None:
    """Refuse both or neither of two alternative arguments."""
    given = [name for name, value in arguments.items() if value]
    if len(given) != 1:
        first, second = arguments
        raise QueryError(
            f"{first} and {second}",
            expected="one of the two",
            found="both" if given else "neither",
            remedy=f"give {first} or {second}" if not given else f"leave out {first} or {second}",
        )


def _facts(scene: Scene) -> dict[str, Any]:
    return {
        "gaussians": len(scene.gaussians),
        "views": len(scene.views),
        "meters_per_unit": scene.world.meters_per_unit,
        "method": scene.field.method,
        "unsaved_steps": unsaved_steps(scene.folder) if scene.folder else 0,
    }


def _facts_or_problem(served: OpenScene) -> dict[str, Any]:
    try:
        return _facts(served.scene)
    except LexsplatError as error:  # the other scenes are listed all the same
        return {"problem": str(error)}


def _remark(facts: Mapping[str, Any]) -> str:
    if "problem" in facts:
        return f" ({facts['problem']})"
    return f" ({counted(facts['unsaved_steps'], 'unsaved step')})" if facts["unsaved_steps"] else ""
