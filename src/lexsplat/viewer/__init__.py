"""The page of `lexsplat.scenes.publishing` with a server behind it: ``lexsplat view SCENE``.

    from lexsplat.viewer.server import ViewerConfig, ViewerServer
    viewer = ViewerServer(lexsplat.open_scene("output/demo"), ViewerConfig(port=8080))

`session` answers questions, clicks and edits. `requests` reads the requests of pages. `app` has the paths. `guard`
decides who may connect. `server` listens. `coloring` and `history` are helpers of the session.
"""
