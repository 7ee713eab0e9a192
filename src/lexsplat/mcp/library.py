"""The tool that searches a library of scenes, offered where a library is served."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from lexsplat.mcp import answers
from lexsplat.mcp.tools import PhraseText, Reply, Tools


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
        listed = "; ".join(map(repr, found.hits))
        said = f"In {len(found.hits)} of {found.scenes} scenes: {listed}" if found.hits else "In no scene."
        more = f" {found.unopened} more scenes may hold it." if found.unopened else ""
        skipped = f" {len(found.skipped)} scenes could not be asked." if found.skipped else ""
        return Reply(said + more + skipped, found.to_dict())
