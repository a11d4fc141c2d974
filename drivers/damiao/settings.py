"""What a can:// address says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.address import Address
from drivers.damiao.bus_time import BusTime, budget
from drivers.damiao.codec import REPLY_OFFSET
from drivers.interface import DriverError

VIRTUAL, MULTICAST = "virtual", "udp_multicast"
MULTICAST_PORT = 43113  # python-can's own choice
RANGES = {
    "bitrate": (10_000, 1_000_000),  # CAN's highest arbitration rate
    "data_bitrate": (10_000, 10_000_000),
    "rate": (20, 1000),  # Hz; a motor's time-out is far above the longest period
    "joints": (1, 15),  # four bits name the motor in a reply
    "first_id": (1, 15),
    "reply_offset": (1, 0x7E0),
}
OPTIONS = ("interface", "fd", *RANGES, "guardian")


@dataclass(frozen=True)
class BusSettings:
    """A CAN arm's address, read.

    Attributes:
        channel: of the interface: can0, a multicast group, a name.
        interface: of python-can.
        port: of udp_multicast.
        fd: FD frames with bit-rate switch.
        bitrate, data_bitrate: bit/s. Under socketcan `ip link` sets them, and these only serve
            the budget.
        rate_hz: of ticks.
        joints: motors on the bus, with successive ids from `first_id` on.
        reply_offset: reply id minus command id.
        guardian: whether a process of its own holds the arm where the loop does not.
    """

    channel: str
    interface: str = "socketcan"
    port: int = MULTICAST_PORT
    fd: bool = True
    bitrate: int = 1_000_000
    data_bitrate: int = 5_000_000
    rate_hz: int = 1000
    joints: int = 7
    first_id: int = 1
    reply_offset: int = REPLY_OFFSET
    guardian: bool = True

    @property
    def ids(self) -> range:
        """Command ids."""
        return range(self.first_id, self.first_id + self.joints)

    @property
    def reply_ids(self) -> tuple[int, ...]:
        """Reply ids, in the order of `ids`."""
        return tuple(can_id + self.reply_offset for can_id in self.ids)

    @property
    def budget(self) -> BusTime:
        """Bus time of one tick's frames. Raises DriverError where they do not fit."""
        return budget(self.joints, self.rate_hz, self.fd, self.bitrate, self.data_bitrate)

    @classmethod
    def of(cls, address: str, joint_names: Sequence[str] | None = None) -> BusSettings:
        """Read `can://CHANNEL?interface=...`. Raises DriverError, naming the choices."""
        parts = Address.of(address, OPTIONS)
        if parts.scheme != "can":
            raise DriverError(f"'{address}' is no CAN arm; write can://CHANNEL?interface=...")
        options = dict(parts.options)
        interface = options.pop("interface", cls.interface)
        if parts.port is not None and interface != MULTICAST:
            raise DriverError(f"'{address}': only interface={MULTICAST} takes a port")
        flags = {key: _flag(key, options.pop(key)) for key in ("fd", "guardian") if key in options}
        numbers = {key: _number(key, text) for key, text in options.items()}
        if joint_names is not None and "joints" not in numbers:
            numbers["joints"] = len(joint_names)
        found = cls(
            channel=parts.host,
            interface=interface,
            port=MULTICAST_PORT if parts.port is None else parts.port,
            rate_hz=numbers.pop("rate", cls.rate_hz),
            **flags,
            **numbers,  # type: ignore[arg-type]  # whole numbers, by their names
        )
        found.check(joint_names)
        return found

    def check(self, joint_names: Sequence[str] | None) -> None:
        """Raises DriverError where parts of the address contradict each other."""
        if joint_names is not None and len(joint_names) != self.joints:
            raise DriverError(
                f"the address says joints={self.joints}, the arm's description {len(joint_names)}"
            )
        if self.ids[-1] > 15:
            raise DriverError(f"motor ids would reach {self.ids[-1]}; a reply names at most 15")
        if set(self.ids) & set(self.reply_ids) or self.reply_ids[-1] >= 0x7FF:
            raise DriverError(
                f"reply_offset={self.reply_offset} mixes replies with commands; take {REPLY_OFFSET}"
            )


def joint_count(address: str) -> int | None:
    """Number of joints that an address says, None where it does not. Raises DriverError."""
    text = dict(Address.of(address, OPTIONS).options).get("joints")
    return None if text is None else _number("joints", text)


def _flag(key: str, text: str) -> bool:
    if text not in ("0", "1"):
        raise DriverError(f"option {key} is 0 or 1, not '{text}'")
    return text == "1"


def _number(key: str, text: str) -> int:
    low, high = RANGES[key]
    if not text.isdecimal() or not low <= int(text) <= high:
        raise DriverError(f"option {key} is a whole number from {low} to {high}, not '{text}'")
    return int(text)
