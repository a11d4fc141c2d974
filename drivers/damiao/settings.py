"""What a can:// address says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.address import Address, number_of
from drivers.damiao.codec import REPLY_OFFSET
from drivers.interface import DriverError

# By whether frames are FD: bits of a torque command and of a state reply, each the mean of 200 such
# as an arm has them, and of the longest frame; each (at the arbitration rate, at the data rate),
# with stuff bits and the gap behind (ISO 11898-1). Of an FD frame those up to BRS and from ACK on
# go at the arbitration rate.
BITS = {
    False: ((122.945, 0.0), (114.94, 0.0), (135, 0)),
    True: ((30.435, 106.86), (30.0, 99.32), (33, 114)),
}


@dataclass(frozen=True)
class BusTime:
    """Bus time of one tick.

    Attributes:
        typical_us, worst_us: of all its frames, back to back.
        reply_us: typical, of one reply.
        load: typical share of the tick.
    """

    typical_us: float
    worst_us: float
    reply_us: float
    load: float


def budget(
    joints: int, rate_hz: int, fd: bool, bitrate: int, data_bitrate: int | None = None
) -> BusTime:
    """Bus time of one command to and one reply from each joint.

    Args:
        joints: on this bus.
        rate_hz: of ticks.
        fd: FD frames with bit-rate switch.
        bitrate, data_bitrate: bit/s; the latter `bitrate` where None or not FD.

    Raises:
        DriverError: they do not fit; the message says what would.
    """
    found = frame_times(joints, rate_hz, fd, bitrate, data_bitrate)
    if _fits(found, rate_hz):
        return found
    ways = []
    for rate in (1000, 800, 500, 400, 250, 200, 100, 50):
        slower = frame_times(joints, rate, fd, bitrate, data_bitrate)
        if rate < rate_hz and _fits(slower, rate):
            ways.append(f"at most {rate} Hz (?rate={rate})")
            break
    for data_rate in (5_000_000, 8_000_000):
        faster = frame_times(joints, rate_hz, True, bitrate, data_rate)
        if _fits(faster, rate_hz):
            ways.append(f"CAN FD with {data_rate / 1e6:g} Mbit/s (?fd=1&data_bitrate={data_rate})")
            break
    ways.append("fewer joints on this bus")
    fast = f"/{(data_bitrate or bitrate) / 1e6:g}" if fd else ""
    kind = f"{'CAN FD' if fd else 'classic CAN'} {bitrate / 1e6:g}{fast}"
    raise DriverError(
        f"{2 * joints} frames take {found.typical_us:.0f} us (at worst {found.worst_us:.0f}) on "
        f"{kind} Mbit/s: {100 * found.load:.0f} % of a tick at {rate_hz} Hz; what fits: "
        + ", or ".join(ways)
    )


def frame_times(
    joints: int, rate_hz: int, fd: bool, bitrate: int, data_bitrate: int | None = None
) -> BusTime:
    """As `budget`, without judging."""
    fast = float(data_bitrate or bitrate) if fd else float(bitrate)
    command, reply, worst = (
        1e6 * (slow_bits / bitrate + fast_bits / fast) for slow_bits, fast_bits in BITS[fd]
    )
    typical_us = joints * (command + reply)
    return BusTime(typical_us, 2 * joints * worst, reply, typical_us * rate_hz / 1e6)


def _fits(found: BusTime, rate_hz: int) -> bool:
    return found.load <= 0.85 and found.worst_us * rate_hz / 1e6 <= 1.0  # motors need gaps


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
        parts = Address.of(address, ("interface", "fd", *RANGES, "guardian"))
        if parts.scheme != "can":
            raise DriverError(f"'{address}' is no CAN arm; write can://CHANNEL?interface=...")
        options = dict(parts.options)
        interface = options.pop("interface", cls.interface)
        if parts.port is not None and interface != MULTICAST:
            raise DriverError(f"'{address}': only interface={MULTICAST} takes a port")
        flags = {key: parts.flag(key) for key in ("fd", "guardian") if key in options}
        numbers = {
            key: int(number_of(key, text, *RANGES[key]))
            for key, text in options.items()
            if key not in flags
        }
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
