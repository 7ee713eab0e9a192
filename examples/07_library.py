"""Which of many scenes holds a thing: a table, as in a notebook.

    python examples/07_library.py [SCENE ... [--ask PHRASE ...]]

SCENE is a folder that `lexsplat build` made, or the word "demo" for the scene that ships with lexsplat.
"""

# %% A library is a folder. Scenes stay where they are; adding one again brings it up to date.
import sys
from pathlib import Path

from lexsplat.scenes.library import Library

words = sys.argv[1:]
cut = words.index("--ask") if "--ask" in words else len(words)
scenes, phrases = (
    words[:cut] or ["demo"],
    words[cut + 1 :] or ["red apple", "mug on the cloth", "fire extinguisher"],
)
library = Library.create(Path("output/examples/library"))
for scene in scenes:
    library.add(scene)
print(library)

# %% One row for each thing. `pandas.DataFrame(rows)` shows them as a table.
rows = []
for phrase in phrases:
    found = library.search(phrase)
    rows += found.rows()
    for hit in found.hits:
        hit.write_picture(Path("output/examples/found"))
    print(found)

# %% The table
if rows:
    print(" | ".join(rows[0]))
for row in rows:
    print(" | ".join(str(value) for value in row.values()))
