"""What an address says after its scheme: //HOST:PORT/REST?KEY=VALUE&..."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import parse_qsl, urlsplit

from drivers.errors import DriverError, choices


@dataclass(frozen=True)
class Address:
    """The parts of `SCHEME://HOST:PORT?KEY=VALUE&...`.

    Attributes:
        scheme: before the colon.
        host: between // and the port or the question mark; a bus channel keeps its case.
        port: None where none is given.
        options: after the question mark.
    """

    scheme: str
    host: str
    port: int | None
    options: dict[str, str]

    @classmethod
    def of(cls, address: str, known: Sequence[str]) -> Address:
        """Parse an address whose options may be `known`. Raises DriverError, naming the choices."""
        parts = urlsplit(address)
        host, colon, tail = parts.netloc.rpartition(":")
        if not colon or (":" in host and not host.startswith("[")):  # no port, or bare IPv6
            host, tail = parts.netloc, ""
        if host.startswith("[") and host.endswith("]"):
            host = host[1:-1]
        if not host:
            raise DriverError(f"'{address}' names nobody; write {parts.scheme}://WHERE?KEY=VALUE")
        if tail and not tail.isdecimal():
            raise DriverError(f"'{address}': port '{tail}' is not a number")
        pairs = parse_qsl(parts.query, keep_blank_values=True)
        options = dict(pairs)
        if len(options) < len(pairs):
            raise DriverError(f"'{address}': an option is given twice")
        for key in options:
            if key not in known:
                raise DriverError(f"'{address}': no option '{key}'; {choices(key, known)}")
        return cls(parts.scheme, host, int(tail) if tail else None, options)

    def flag(self, key: str, default: bool = False) -> bool:
        """An option that is 0 or 1. Raises DriverError."""
        text = self.options.get(key, str(int(default)))
        if text not in ("0", "1"):
            raise DriverError(f"option {key} is 0 or 1, not '{text}'; write {key}=1 or {key}=0")
        return text == "1"

    def number(self, key: str, default: float, low: float, high: float) -> float:
        """An option as a number from low to high, a whole one where these are.

        Raises DriverError.
        """
        return number_of(key, self.options.get(key, str(default)), low, high)


def number_of(key: str, text: str, low: float, high: float) -> float:
    """As `Address.number`, of a text."""
    whole = isinstance(low, int)
    try:
        value = int(text) if whole else float(text)
    except ValueError:
        value = low - 1
    if not low <= value <= high:
        kind = "whole number" if whole else "number"
        raise DriverError(f"option {key} is a {kind} from {low} to {high}, not '{text}'")
    return value
