"""The tool that searches a library of scenes, offered where a library is served."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from lexsplat.mcp import answers
from lexsplat.mcp.tools import PhraseText, Reply, Tools
from lexsplat.scenes.serving import counted, shortened


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
            where = "no scene that could be asked" if found.present == "unsure" else "no scene"
            text = f"In {where}: nothing fits {shortened(found.understood)}."
        note = f" Note: {found.note}." if found.note else ""
        more = f" {counted(found.unopened, 'more scene')} may hold it." if found.unopened else ""
        skipped = f" {counted(len(found.skipped), 'scene')} could not be asked." if found.skipped else ""
        return Reply(text + note + more + skipped, found.to_dict())
