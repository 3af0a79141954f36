"""The conversation with a flock of miniBIRDs: from closed ports to a stream, and back.

Start sequence and silences: Ascension, Flock of Birds Installation and Operation Guide, Rev B, "auto-configuration".
"""

from __future__ import annotations

import errno
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import serial

from trainer.drivers import minibird_commands as commands
from trainer.drivers.minibird_record import WORDS, RecordParser, decode
from trainer.drivers.serial_port import DeviceError, open_port, read_some, set_reset
from trainer.geometry import Array, quaternion_conjugate, quaternion_from_euler_deg
from trainer.profile import MinibirdSpec

#: A rotation of less than 8° does not tell a quaternion from its inverse: 1 - cos 8° = 0.01.
SENSE = 0.01
#: Angles and quaternion of one bird agree to this cosine of half the angle between them (16°), or bytes were spoilt.
AGREE = 0.99
TRIES = 4  # at asking
#: The most units of a flock with normal addresses.
MOST = 14


@dataclass(frozen=True)
class Silences:
    """How long the units need to be left alone, s."""

    reset_s: float = 2.0  # after the port was opened, which may pulse RTS, or after a reset
    hold_s: float = 1.0  # RTS, to reset
    configure_s: float = 0.7  # before and after AUTO-CONFIG; the manual wants 0.6
    drain_s: float = 0.05  # after the stream was stopped
    answer_s: float = 0.5  # for an answer to come


#: As the units want it.
UNHURRIED = Silences()


class Flock:
    """The units of a profile; ``pause`` sleeps, and may raise to give up."""

    def __init__(
        self, spec: MinibirdSpec, silences: Silences = UNHURRIED, pause: Callable[[float], object] = time.sleep
    ) -> None:
        self._spec = spec
        self._silences = silences
        self._pause = pause
        self._addresses = tuple(sorted(bird.address for bird in spec.bird))
        #: The unit that speaks for all is that of address 1, also where it moves nothing.
        self._master = 1 if spec.port else self._addresses[0]
        self._urls = {b.address: b.port for b in spec.bird} if not spec.port else {self._master: spec.port}
        self._ports: dict[int, Any] = {}  # by the address of the unit that is plugged in there
        self._at = self._master  # at whose port something was said last
        group = bool(spec.port)
        everyone = tuple(range(1, self._addresses[-1] + 1))
        #: Of what comes at each port. They last as long as the flock: where a bird was before a loss tells whether it
        #: is on the other side of its hemisphere afterwards.
        self.parsers = {
            address: RecordParser(everyone if group else (address,), group, 10.0 / spec.baud) for address in self._urls
        }
        self.inverse: dict[int, bool] = {}  # birds whose quaternions are those of the inverse rotation

    def connect(self) -> None:
        """Open, reset, configure and set up; then ``begin`` starts the stream. Raises DeviceError."""
        try:
            for address, url in self._urls.items():
                self._ports[address] = open_port(url, self._spec.baud)
            if self._spec.reset:
                for held, seconds in ((True, self._silences.hold_s), (False, 0.0)):
                    for port in self._ports.values():
                        set_reset(port, held)
                    self._pause(seconds)
            self._pause(self._silences.reset_s)
            for address in self._ports:
                self._introduce(address)
                self._say(address, commands.change(commands.GROUP_MODE, b"\x00"))  # as an earlier program left it
            self._configure()
            self._undo()
            self._say(self._master, commands.measurement_rate(self._spec.rate_hz))
            for address in self._addresses:
                self._set_up(address)
            if self._spec.port:
                for address in set(range(1, self._addresses[-1])).difference(self._addresses):
                    self._say(address, commands.POSITION_QUATERNION)  # all records of a group are of one length
                self._say(self._master, commands.change(commands.GROUP_MODE, b"\x01"))
            self._check_error()
        except OSError as error:
            self.disconnect()
            why = "the port is gone; plug it in again"
            if isinstance(error, serial.SerialTimeoutException):
                why = "takes no bytes; is it the tracker's?"
            elif error.errno == errno.ENOSPC:  # of spy://
                why = "its log of bytes cannot be written: the disk is full"
            raise DeviceError(f"{self._urls[self._at]}: {why}") from None
        except BaseException:
            self.disconnect()
            raise

    def begin(self) -> dict[int, tuple[Any, RecordParser]]:
        """Start the stream; ports with the parser of what comes. Raises OSError where a port is gone."""
        for address in self._ports:
            self.parsers[address].begin()
            self._say(address, commands.STREAM)
        return {address: (port, self.parsers[address]) for address, port in self._ports.items()}

    def disconnect(self) -> None:
        """Stop the stream, have the transmitter rest and close the ports, as far as they are still there."""
        ports, self._ports = self._ports, {}
        for address, port in ports.items():
            try:
                port.write(commands.STREAM_STOP)
                if address == self._master:
                    port.write(commands.SLEEP)
            except OSError:
                pass  # it is gone already
            finally:
                port.close()

    @property
    def _url(self) -> str:
        return self._urls[self._master]

    def _say(self, address: int, command: bytes) -> None:
        """To the unit at a port of its own, or by its prefix through the master's."""
        own = address in self._ports
        self._at = address if own else self._master
        self._ports[self._at].write(commands.to_bird(None if own else address, command))

    def _ask(self, address: int, command: bytes, count: int) -> bytes:
        """The answer of ``count`` bytes, asked for again where bytes of it are lost. Raises DeviceError."""
        at = address if address in self._ports else self._master
        for attempt in range(TRIES):
            self._say(address, command)
            answer, ends = b"", time.monotonic() + self._silences.answer_s
            while len(answer) < count and time.monotonic() < ends:
                answer += self._ports[at].read(count - len(answer))
            if len(answer) == count:
                return answer
            if not answer and not attempt:
                break  # nobody is there
            self._drain(at)
        heard = "less than asked for" if answer else "nothing"
        raise DeviceError(
            f"{self._urls[at]}: bird {address} answers {heard}; is it on, its switch on fly, and the baud rate "
            f"{self._spec.baud} as its switches say?"
        )

    def _hush(self, address: int) -> None:
        """End a stream that was left running, and drop what is still on its way."""
        self._say(address, commands.STREAM_STOP)
        self._say(address, commands.POINT)
        self._drain(address)

    def _drain(self, address: int) -> None:
        ends = time.monotonic() + self._silences.drain_s
        longest = time.monotonic() + 20.0 * self._silences.drain_s
        while time.monotonic() < ends:
            if read_some(self._ports[address]):
                ends = time.monotonic() + self._silences.drain_s
            if time.monotonic() > longest:
                raise DeviceError(f"{self._urls[address]}: talks without end; is it a tracker?")

    def _introduce(self, address: int) -> None:
        """Two looks at the status word must agree, whatever is at the port. Its error bit is cleared by the first."""
        ask = commands.examine(commands.STATUS)
        url = self._urls[address]
        for _ in range(TRIES):
            self._hush(address)
            first, second = (self._ask(address, ask, 2) for _ in range(2))
            if first[0] == second[0] and not (first[1] ^ second[1]) & 0xDF:
                break
        else:
            raise DeviceError(f"{url}: no tracker's answers; check the port and the baud rate {self._spec.baud}")
        status = commands.UnitStatus.read(second)
        if status.expanded:
            raise DeviceError(f"{url}: the units are set to expanded addresses; set them to normal ones (1 to {MOST})")
        if status.master != (address == self._master):
            found, wanted = ("the master", "not") if status.master else ("not the master", "the one")
            raise DeviceError(f"{url}: this unit is {found}, {wanted} of address {self._master}; exchange the ports")
        self._ask(address, commands.examine(commands.ERROR), 1)  # of what came before; reading clears it

    def _configure(self) -> None:
        found = self._birds()
        if any(not found[address - 1].accessible for address in self._addresses):
            found = self._birds()  # a spoilt byte says the same as a bird that is not there
        missing = [a for a in range(1, self._addresses[-1] + 1) if not found[a - 1].accessible]
        if missing:
            raise DeviceError(
                f"{self._url}: bird {missing[0]} is not there; check its power, its fly switch, its address and the "
                "cable between the units"
            )
        self._pause(self._silences.configure_s)
        self._say(self._master, commands.change(commands.AUTO_CONFIGURATION, bytes((self._addresses[-1],))))
        self._pause(self._silences.configure_s)
        self._check_error()
        self._say(self._master, commands.RUN)  # an earlier program may have sent it to sleep
        found = self._birds()
        for address in self._addresses:
            bird = found[address - 1]
            if not (bird.accessible and bird.running and bird.sensor):
                lacks = "does not run" if not bird.running else "has no sensor; plug it in"
                raise DeviceError(f"{self._url}: bird {address} {lacks}")

    def _birds(self) -> list[commands.BirdStatus]:
        reply = self._ask(self._master, commands.examine(commands.FLOCK_STATUS), MOST)
        return [commands.BirdStatus.read(byte) for byte in reply]

    def _undo(self) -> None:
        """What an earlier program may have left: records that are left out, or that are longer by a byte."""
        for address in range(1, self._addresses[-1] + 1) if self._spec.port else self._addresses:
            for command in (commands.REPORT_EACH_CYCLE, commands.NO_BUTTON, commands.NO_METAL):
                self._say(address, command)

    def _set_up(self, address: int) -> None:
        self._say(address, commands.hemisphere(self._spec.hemisphere))
        self._say(address, commands.change(commands.POSITION_SCALE, b"\x00\x00"))  # 36 inches
        if self._spec.quaternion != "measured":
            self.inverse[address] = self._spec.quaternion == "inverse"
        elif address not in self.inverse:
            self.inverse[address] = self._sense(address)
        self._say(address, commands.POSITION_QUATERNION)

    def _sense(self, address: int) -> bool:
        """Whether a bird's quaternion is that of the inverse of the rotation that its angles say."""
        for _ in range(TRIES):
            self._say(address, commands.POSITION_ANGLES)
            azimuth, elevation, roll = np.array(decode(self._ask(address, commands.POINT, 12))[3:]) * (180.0 / 32768.0)
            by_angles = quaternion_from_euler_deg((roll, elevation, azimuth))
            self._say(address, commands.POSITION_QUATERNION)
            sent: Array = np.array(decode(self._ask(address, commands.POINT, 2 * WORDS))[3:]) / 32768.0
            direct, inverse = abs(float(sent @ by_angles)), abs(float(quaternion_conjugate(sent) @ by_angles))
            if max(direct, inverse) > AGREE and abs(direct - inverse) >= SENSE:
                return inverse > direct
        raise DeviceError(
            f"{self._url}: bird {address} lies too straight to tell the sense of its quaternions; tilt it by 20° and "
            "start again, or set 'quaternion' to direct or inverse"
        )

    def _check_error(self) -> None:
        code = self._ask(self._master, commands.examine(commands.ERROR), 1)[0]
        if code:
            raise DeviceError(f"{self._url}: error {code}: {commands.error_text(code)}")
