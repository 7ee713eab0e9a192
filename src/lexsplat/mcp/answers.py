"""Types of the tools' answers, from which `lexsplat.mcp.server` makes the output schemas.

The documents are those of the commands (docs/schemas); the tests compare both.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from typing_extensions import NotRequired, TypedDict

Present = Annotated[
    Literal["yes", "unsure", "no"],
    Field(description='"no": the scene does not hold it, and nothing is listed.'),
]
Vector = Annotated[list[float], Field(min_length=3, max_length=3, description="x, y, z in scene units.")]
View = Annotated[str | None, Field(description="Name of the view that shows it best.")]
Count = Annotated[int, Field(ge=0)]
Unsaved = Annotated[
    int, Field(ge=0, description="Steps of lexsplat edit and the viewer that the scene does not hold.")
]

Up = TypedDict(
    "Up",
    {
        "direction": Vector,
        "reliable": bool,
        "from": Annotated[str, Field(description="cameras, splats or user")],
    },
)


class World(TypedDict):
    """Axes and unit of a scene."""

    up: Up
    meters_per_unit: Annotated[float | None, Field(description="null while the scale is not known.")]


class Instance(TypedDict):
    """One thing, in an upright box."""

    name: str
    gaussians: Count
    score: Annotated[float, Field(ge=0, le=1, description="Mean relevancy.")]
    center: Vector
    size: Vector
    center_meters: NotRequired[list[float]]
    size_meters: NotRequired[list[float]]
    axes: list[Vector]
    best_view: View


class Certainty(TypedDict):
    """Whether the scene holds something, and where it is seen best."""

    present: Present
    threshold: Annotated[
        float, Field(description="Relevancy from which a Gaussian matches; of two phrases, the lower one.")
    ]
    best_view: View


class Asked(Certainty):
    """How phrases were understood, and whether the scene holds what they name."""

    understood: str
    note: Annotated[
        str,
        Field(description="What was not understood, corrected, or chosen among several; empty if nothing."),
    ]


class Counted(World, Asked):
    """The number of things."""

    phrase: str
    count: Count


class Answer(Asked):
    """The things of one phrase."""

    phrase: str
    count: Count
    gaussians: Count
    instances: list[Instance]


class FindAnswer(World):
    """The document of ``lexsplat find --json``."""

    scene: str | None
    rests_on: Annotated[str, Field(description="What relevancy and presence are relative to.")]
    unsaved_steps: Unsaved
    phrases: list[Answer]


class RelateAnswer(World, Answer):
    """The things that stand in the relation."""

    holds: Literal["yes", "perhaps", "no"]
    seen_from: Annotated[
        str | None,
        Field(description="The views that left, right, front and behind refer to; null for other relations."),
    ]


class Name(TypedDict):
    """A candidate name of an object."""

    name: str
    probability: float


class Object(Instance):
    """An object with its likeliest names."""

    names: list[Name]
    colors: list[str]
    surface: Annotated[bool, Field(description="A table, a wall, ...: no thing.")]


class ListAnswer(World):
    """The document of ``lexsplat list --json``."""

    scene: str | None
    rests_on: str
    words: Count
    note: str
    picture: str | None
    objects: list[Object]


class Facts(TypedDict):
    """Facts of a scene."""

    gaussians: Count
    views: Count
    meters_per_unit: float | None
    method: str
    unsaved_steps: Unsaved


class SceneFacts(TypedDict):
    """Facts of a named scene, or why there are none."""

    name: str
    gaussians: NotRequired[Count]
    views: NotRequired[Count]
    meters_per_unit: NotRequired[float | None]
    method: NotRequired[str]
    unsaved_steps: NotRequired[Unsaved]
    problem: NotRequired[Annotated[str, Field(description="Why it cannot be asked.")]]


class LibraryFacts(TypedDict):
    """The first names of a library, or why there are none."""

    scenes: NotRequired[Count]
    names: NotRequired[list[str]]
    problem: NotRequired[Annotated[str, Field(description="Why it cannot be asked.")]]


class ScenesAnswer(TypedDict):
    """The places that can be searched."""

    scenes: list[SceneFacts]
    library: NotRequired[LibraryFacts]


class SceneAnswer(Facts):
    """A place."""

    up: Up
    extent: Annotated[list[Vector], Field(description="Lowest and highest corner, without the outer 1 %.")]
    view_names: list[str]
    things: list[str]
    encoder: dict[str, str]


class Length(TypedDict):
    """A length."""

    units: float
    meters: float | None


class NearestAnswer(World, Asked):
    """The nearest thing."""

    distance: Length
    nearest: Instance
    to: Annotated[Instance | None, Field(description="The thing it is nearest to; null for a point.")]
    among: Annotated[int, Field(description="Number of things compared.")]


class MeasureAnswer(World, Asked):
    """Lengths between two different things; of several, between the nearest pair."""

    first: Instance
    second: Instance
    centers: Length
    gap: Length
    height: Annotated[Length, Field(description="How much higher the second is.")]


class PixelAnswer(World, Certainty):
    """The thing at a pixel."""

    name: Annotated[str, Field(description="Empty if no known thing is there.")]
    view: str
    x: float
    y: float
    surface: Instance
    thing: Instance | None


class Heat(Asked):
    """A phrase that is drawn as heat."""

    phrase: str
    peak: float


class RenderAnswer(World):
    """Content of the rendered image."""

    view: str
    look_at: Annotated[Asked | None, Field(description="null where the view was given.")]
    legend: list[Heat]


class Hit(World):
    """A scene that holds it."""

    scene: str
    path: str
    encoder: str
    bound: Annotated[float, Field(description="Upper bound of the strength of presence.")]
    source: Annotated[Literal["index", "scene"], Field(description="What answered.")]
    understood: str
    note: str
    present: Literal["yes", "unsure"]
    count: Count
    gaussians: Count
    threshold: float
    best_view: View
    instances: list[Instance]


class Problem(TypedDict):
    """A problem of a scene in a library."""

    scene: str
    problem: str


class LibraryAnswer(TypedDict):
    """One phrase of ``lexsplat library search --json``."""

    phrase: str
    understood: Annotated[str, Field(description="What was searched, with typing errors corrected.")]
    note: Annotated[str, Field(description="What was not understood or was corrected; empty if nothing.")]
    present: Annotated[
        Literal["yes", "unsure", "no"],
        Field(description='"no": each scene was asked or ruled out, and none holds it.'),
    ]
    scenes: Count
    opened: Count
    unopened: Annotated[int, Field(description="Scenes that may hold it and were not opened.")]
    hits: list[Hit]
    skipped: Annotated[list[Problem], Field(description="Scenes that could not be asked.")]
    rebuilt: Annotated[
        list[Problem], Field(description="Scenes that were built again since they were added.")
    ]
    encoders: list[str]


class ExportAnswer(World, Asked):
    """The files that were written."""

    files: list[str]
    gaussians: Count
    unsaved_steps: Unsaved


class EditAnswer(World, Asked):
    """The scene that was written."""

    scene: Annotated[str, Field(description="Its folder.")]
    name: Annotated[str, Field(description="The name by which this server serves it.")]
    action: str
    gaussians: Count
