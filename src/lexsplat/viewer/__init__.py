"""The viewer: a scene in the browser, colored by what one asks (``lexsplat view SCENE``).

    from lexsplat.viewer.server import ViewerConfig, ViewerServer
    viewer = ViewerServer(lexsplat.open_scene("output/demo"), ViewerConfig(port=8080))

Pure and tested without a browser: `coloring` (a color for every Gaussian), `splats` (what is sent), `session` (what
is asked, clicked and selected), `memory`, `vocabulary`, `recording`, `pages` (all HTML), `guard` (who may connect).
Only `server`, `display` and `panels` know viser.
"""
