"""The viewer: a scene in the browser, colored by the answers to prompts (``lexsplat view SCENE``).

    from lexsplat.viewer.server import ViewerConfig, ViewerServer
    viewer = ViewerServer(lexsplat.open_scene("output/demo"), ViewerConfig(port=8080))

Without viser: `coloring` (a color for every Gaussian), `splats` (what is sent), `session` (prompts, clicks and
selections), `history` and `vocabulary`, `recording` (orbits and videos), `pages` (HTML from `templates/`).
With viser: `server` and its `guard` (who may connect), `display` (the scene), `panels` and its parts (the controls).
"""
