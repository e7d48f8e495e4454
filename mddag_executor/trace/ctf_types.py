# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the metadata of a CTF trace says: the types of its packets and events.

Theory of operation:

1. The metadata of CTF 1.8 is a text in a language of its own (`tsdl`), that of CTF 2 is JSON
   (`ctf2_metadata`).  Both become these types, and the packets are the same.
2. Sizes, alignments, and how deep and how large types are, are checked when a type is made,
   because every type is turned into a layout later.
3. The names of what the heads of packets and events say are those of LTTng (`id`, `timestamp`,
   `packet_size`, …).  CTF 2 has roles instead; a member with a role gets its name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

MOST_MEMBERS = 5000
"""Primitive members of one structure, nested ones included."""
MOST_BYTES = 8 * 1024 * 1024
"""Size of the metadata."""
DEEPEST = 24
NS = 10 ** 9


class MetadataError(ValueError):
    """Metadata that cannot be understood."""


class Location(NamedTuple):
    """
    Where the field is that says how long an array is, or which option of a variant is used.

    :ivar origin: the name of the structure in which its path begins; empty: one that is being
        read.
    :ivar above: how far this structure is above the one with the array or variant; -1: it is the
        nearest one that has such a member.
    """

    path: tuple[str, ...]
    origin: str = ''
    above: int = -1


@dataclass(frozen=True)
class Integer:
    """
    An integer.

    :ivar align: bits, as in all types.
    :ivar text: whether it is a character.
    :ivar clock: whether it is a time of the clock.
    """

    bits: int
    align: int
    signed: bool = False
    big: bool = False
    text: bool = False
    clock: bool = False
    leaves = 1


@dataclass(frozen=True)
class Float:
    """A floating-point number of 32 or 64 bits."""

    bits: int
    align: int
    big: bool = False
    leaves = 1


@dataclass(frozen=True)
class Text:
    """Characters that end with NUL."""

    align = 8
    leaves = 1


@dataclass(frozen=True)
class Enumeration:
    """An integer whose values have names: name, first and last value."""

    container: Integer
    labels: tuple[tuple[str, int, int], ...]
    leaves = 1

    @property
    def align(self) -> int:
        """Return the alignment of the integer."""
        return self.container.align

    def label(self, value: int) -> str | None:
        """Return the first name of a value; None: it has none."""
        return next((name for name, low, high in self.labels if low <= value <= high), None)


@dataclass(frozen=True)
class Array:
    """
    A number of elements that is known (`count`) or that another field has (`length`).

    :ivar least_align: its alignment, if that of an element is less.
    """

    element: Type
    count: int
    length: Location | None = None
    least_align: int = 1

    @property
    def align(self) -> int:
        """Return the alignment."""
        return max(self.element.align, self.least_align)

    @property
    def leaves(self) -> int:
        """Return how many primitives a type consists of."""
        return self.element.leaves

    @property
    def text(self) -> bool:
        """Return whether it is a text of characters of a byte."""
        element = self.element
        return isinstance(element, Integer) and element.text and element.bits == 8 and (
            element.align % 8 == 0)


@dataclass(frozen=True)
class Struct:
    """Named members."""

    members: tuple[tuple[str, Type], ...]
    align: int
    leaves: int


@dataclass(frozen=True)
class Variant:
    """
    One of several types, chosen by an integer, or by the name of an enumeration's value.

    :ivar ranges: name, first and last integer of options; empty: they are chosen by name.
    """

    tag: Location
    options: tuple[tuple[str, Type], ...]
    leaves: int
    ranges: tuple[tuple[str, int, int], ...] = ()
    align = 1


Type = Integer | Float | Text | Enumeration | Array | Struct | Variant


@dataclass
class EventClass:
    """A kind of event of a stream."""

    name: str = ''
    context: Struct | None = None
    payload: Struct | None = None


@dataclass
class StreamClass:
    """What the packets and events of a stream consist of."""

    packet_context: Struct | None = None
    header: Struct | None = None
    context: Struct | None = None
    events: dict[int, EventClass] = field(default_factory=dict)


@dataclass
class Clock:
    """
    A clock.

    :ivar offset: ns from its 0 to the epoch's.
    :ivar uuid: that of the boot of its host; empty: unknown.
    """

    frequency: int = NS
    offset: int = 0
    uuid: str = ''


@dataclass
class Metadata:
    """The types of a trace."""

    uuid: str = ''
    packet_header: Struct | None = None
    environment: dict[str, str] = field(default_factory=dict)
    clock: Clock = field(default_factory=Clock)
    streams: dict[int, StreamClass] = field(default_factory=dict)


def structure(members: dict[str, Type], least_align: int = 1) -> Struct:
    """
    Return a structure of members.

    :raises MetadataError: if it is too large
    """
    align = max((kind.align for kind in members.values()), default=1)
    return Struct(tuple(members.items()), max(align, least_align), _leaves(members))


def variant(
    tag: Location, options: dict[str, Type], ranges: tuple[tuple[str, int, int], ...] = ()
) -> Variant:
    """
    Return a variant of options.

    :raises MetadataError: if it is too large
    """
    return Variant(tag, tuple(options.items()), _leaves(options), ranges)


def _leaves(members: dict[str, Type]) -> int:
    found = max(1, sum(kind.leaves for kind in members.values()))
    if found > MOST_MEMBERS:
        raise MetadataError(f'a type has more than {MOST_MEMBERS} members')
    return found


def array(
    element: Type, count: int, length: Location | None = None, least_align: int = 1
) -> Array:
    """
    Return an array whose elements need space, so that its length has a bound.

    :param count: of elements, if it is known.
    :raises MetadataError: if an element may need none
    """
    if smallest(element) == 0:
        raise MetadataError('it has an array of elements without a size')
    return Array(element, count if length is None else -1, length, least_align)


def smallest(kind: Type) -> int:
    """Return the least bits that a type needs."""
    if isinstance(kind, (Integer, Float)):
        return kind.bits
    if isinstance(kind, Enumeration):
        return kind.container.bits
    if isinstance(kind, Text):
        return 8
    if isinstance(kind, Array):
        return max(0, kind.count) * smallest(kind.element)
    if isinstance(kind, Struct):
        return sum(smallest(inner) for _, inner in kind.members)
    return min((smallest(inner) for _, inner in kind.options), default=0)


def size_of(value: int, most: int) -> int:
    """Return a size, or raise MetadataError if it is not possible."""
    if not 1 <= value <= most:
        raise MetadataError(f'{str(value)[:40]!r} is not a possible size')
    return value


def alignment_of(value: int) -> int:
    """Return an alignment, or raise MetadataError if it is not possible."""
    if not 1 <= value <= 4096 or value & value - 1:
        raise MetadataError(f'{str(value)[:40]!r} is not a possible alignment')
    return value
