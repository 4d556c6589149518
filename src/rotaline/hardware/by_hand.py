"""Devices that a person works: the program asks in the terminal, and waits for the answer."""

from collections.abc import Callable

from rotaline.errors import DeviceStateError
from rotaline.hardware.connections import Connections

Ask = Callable[[str], str]
"""Question in, answer out; a person has no time-out."""


def person_of(device: str, deed: str, connections: Connections) -> Ask:
    """Who is asked: ``prompt`` of the connections; ``deed`` is what a person has to do, such as "turn it".

    Raises
    ------
    DeviceStateError
        If there is no terminal.
    """
    ask: Ask | None = connections.get("prompt")
    if ask is None:
        raise DeviceStateError(
            f"{device}: somebody has to {deed}, and there is no terminal to ask in. Work in a terminal."
        )
    return ask


def answer_of(ask: Ask, device: str, text: str, next_step: str) -> str:
    """The answer to a question.

    Raises
    ------
    DeviceStateError
        If the input has ended; ``next_step`` says what to do then.
    """
    try:
        return ask(text)
    except EOFError as error:
        raise DeviceStateError(f"{device}: nobody answers, the input has ended. {next_step}") from error
