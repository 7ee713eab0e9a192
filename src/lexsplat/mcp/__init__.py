"""Tools for language models over the Model Context Protocol (``lexsplat mcp SCENE ...``).

`tools` has the typed functions. `server` offers them with the official ``mcp`` package (extra ``lexsplat[mcp]``) over
standard input and output, or over HTTP.
"""
