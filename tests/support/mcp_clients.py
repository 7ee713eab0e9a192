"""Dialogues with an MCP server through the client of the official package."""

import asyncio
import socket
import threading
import time

import uvicorn
from mcp import Client


def talk(server, dialogue):
    """Run an asynchronous dialogue with a server, in process."""

    async def run():
        async with Client(server) as client:
            return await dialogue(client)

    return asyncio.run(run())


def ask(server, tool, **arguments):
    """The answer of one tool, and the text that goes with it."""
    reply = talk(server, lambda client: client.call_tool(tool, arguments))
    return reply, " ".join(part.text for part in reply.content if part.type == "text")


def served(app):
    """The address of an application that runs while the loop does."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    running = uvicorn.Server(uvicorn.Config(app, host="127.0.0.1", port=port, log_level="error"))
    thread = threading.Thread(target=running.run, daemon=True)
    thread.start()
    while not running.started:
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{port}/mcp"
    finally:
        running.should_exit = True
        thread.join(10)
