# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The stamps in ordinary rosbag2 recordings: arrival times and header stamps of messages.

Theory of operation
-------------------
* A bag is a folder with `metadata.yaml` and the files that it names, or one such file.  Its kind
  (``kinds``) is MCAP (read with ``trace.TraceReader``), SQLite, or
  zstd around one of them (a file-compressed bag, unpacked to a temporary file).
* A message has its arrival (log time), its publication if the recorder stored it separately, and
  the stamp at the beginning of its content, if its type begins with a `std_msgs/Header` or a time.
  The rest is not decoded.
* A topic with a relative name (`AAA`) is the same as in the root namespace (`/AAA`).
* Messages at impossible times (``trace.times``) are dropped and counted, and so are those that are
  more than a year away from most of the others: with `--use-sim-time` the recorder stamps messages
  with 0 until the first `/clock`.
* Damage loses the rest of its file, and is reported.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
import io
import os
from pathlib import Path
import sqlite3
import tempfile
from typing import Any, BinaryIO

from mddag_executor.errors import InputError
from mddag_executor.sources.kinds import (
    BAG_FILE,
    BagError,
    kind_of,
    MCAP,
    METADATA,
    names_in,
    REMEDY,
    SQLITE,
    ZSTD,
)
from mddag_executor.text import counted
from mddag_executor.trace import TraceReader
from mddag_executor.trace.channels import Topic
from mddag_executor.trace.errors import renamed
from mddag_executor.trace.events import Ints
from mddag_executor.trace.times import FAR_NS, NEVER, stretches
from msg_graph import GraphError
from msg_graph.yamltext import parse_yaml, plain
import numpy as np
import zstandard

SET_BACK_NS = 1_000_000_000
"""Messages of several threads are written in nearly the order of their arrivals."""
_ABOUT = 'rosbag2_bagfile_information'
_METADATA_LIMIT = 4 * 1024 * 1024
_MESSAGE_LIMIT = 1 << 30    # bytes of a message, decompressed
_PIECE = 1 << 20
_UNPACKED_LIMIT, _MOST_TIMES = 64 * 1024 * 1024, 1000      # what a whole file may become
_ROWS = 4096                # of an SQLite file that are taken at once
_MOST_TOPICS = 100_000
_STEPS, _STEPS_A_BYTE, _SOME_STEPS = 1_000_000, 8, 10_000
"""
Of SQLite's machine, which may read a file of some bytes; it counts ``_SOME_STEPS`` at once.

A message takes about twenty steps, and more than that in bytes.
"""
_DEFINITIONS_LIMIT = 1024 * 1024    # bytes of the definitions of topics that are used
_STAMP = 12                 # bytes: encapsulation, seconds, nanoseconds
_SHORT = b'\xff' * _STAMP
_WINDOW = 128 * 1024 * 1024
_STAMPED = {'std_msgs/msg/Header', 'builtin_interfaces/msg/Time'}
UNKNOWN = -1
"""A stamp that a message does not have."""


class Stamps:
    """The messages of a topic, in the order of the bag: times in ns, `UNKNOWN` if missing."""

    def __init__(self) -> None:
        self.arrival = array('q')
        self.published = array('q')
        self.header = array('q')
        self.type = ''

    def keep(self, first: int, last: int) -> None:
        """Keep the messages that arrived from one time to another."""
        arrival = np.array(self.arrival)
        kept = (arrival >= first) & (arrival <= last)
        for name in ('arrival', 'published', 'header'):
            setattr(self, name, array('q', np.array(getattr(self, name))[kept].tobytes()))


class Bag:
    """
    Arrivals and stamps of some topics of a bag.

    :param keep: called with each message of these topics: absolute name of the topic, arrival,
        publication (or `UNKNOWN`), and its bytes.
    :ivar topics: every topic in the bag.
    :ivar stamps: by requested topic, if the bag has it.
    :ivar stretches: time ranges without gaps in which messages of any topic arrived (``times``).
    :ivar warnings: missing or doubtful data, one line each.
    """

    def __init__(
        self, path: str | os.PathLike[str], topics: Collection[str], name: str | None = None,
        keep: Callable[[Topic, int, int, bytes], None] | None = None,
    ) -> None:
        self.path = os.fspath(path)
        self.name = name or self.path
        self._keep = keep
        self.count = 0
        self._stated: int | None = None         # number of messages by metadata.yaml
        self._times: list[Any] = []             # arrivals of all messages, by file
        self.topics: set[str] = set()
        self.stamps: dict[str, Stamps] = {}
        self.stretches: list[tuple[int, int]] = []
        self._impossible = 0
        self.warnings: list[str] = []
        self._stamped: dict[tuple[str, str], bool] = {}
        self._definitions = 0           # bytes of those that were read
        files = self._files()
        for file in files:
            try:
                with _unpacked(file) as (unpacked, kind):
                    read = self._read_mcap if kind == MCAP else self._read_sqlite
                    read(unpacked, self._called(file), topics)
            except InputError as error:
                if len(files) == 1:
                    raise BagError(self._called(file), error.problem, error.remedy) from None
                self.warnings.append(f'{file}: {error.problem}: it is left out')
        if self._impossible:
            self.warnings.append(
                f'{self.name}: left out: {counted(self._impossible, "message")} at an impossible '
                'time')
        if self._stated is not None and self._stated != self.count and not self.warnings:
            self.warnings.append(
                f'{self.name}: it has {counted(self.count, "message")}, but metadata.yaml says '
                f'{self._stated}: some may be missing')
        self._leave_out_far_ones()

    def _leave_out_far_ones(self) -> None:
        """Find the stretches of time, without messages that are years from most of the others."""
        times = np.sort(np.concatenate([np.empty(0, dtype=np.int64), *self._times]))
        self._times.clear()
        groups = np.split(times, np.flatnonzero(np.diff(times) > FAR_NS) + 1)
        kept = max(groups, key=len)
        self.stretches = stretches(kept)
        if len(groups) == 1:
            return
        first = next(group[0] for group in groups if group is not kept)
        self.warnings.append(
            f'{self.name}: left out: {counted(len(times) - len(kept), "message")} more than a '
            f'year from the others, the first at {first} ns (with --use-sim-time, messages are '
            'stamped 0 until the first /clock)')
        for stamps in self.stamps.values():
            stamps.keep(int(kept[0]), int(kept[-1]))

    def _files(self) -> list[Path]:
        path = Path(self.path)
        if not os.path.isdir(path):
            return [path]
        names = names_in(self.path)
        found = sorted(path / name for name in names if BAG_FILE.fullmatch(name))
        what = f'{METADATA} is missing'
        if METADATA in names:
            try:
                files, self._stated = _named_files(path / METADATA)
                return [path / name for name in files]
            except BagError as error:
                if not found:
                    raise
                what = f'{METADATA}: {error.problem}'
        if not found:
            raise BagError(self.name, 'there is neither metadata.yaml nor a bag file', REMEDY)
        self.warnings.append(
            f'{self.name}: {what} (the recorder was killed): used '
            f'{counted(len(found), "bag file")} from the folder')
        return found

    def _read_mcap(self, file: Path, called: str, topics: Collection[str]) -> None:
        reader = TraceReader(file)
        relative = {topic[1:] for topic in topics}
        for some in reader.messages({*topics, *relative}):
            for each in some:
                self._add(each.topic, each.log_time.view(np.int64),
                          each.publish_time.view(np.int64), each.heads(_STAMP), each.content)
            if self._keep is not None:      # in the order of the file
                for _, which, number in sorted(
                        (start, which, number) for which, each in enumerate(some)
                        for number, start in enumerate(each.starts.tolist())):
                    each = some[which]
                    self._give(each.topic, int(each.log_time[number]),
                               int(each.publish_time[number]), each.content(number))
        self.warnings += [renamed(text, reader.path, called) for text in reader.warnings]
        self.topics |= {_absolute(topic.name) for topic in reader.topics.values()}
        self._look_through(reader.times)

    def _read_sqlite(self, file: Path, called: str, topics: Collection[str]) -> None:
        times = array('q')
        known: dict[int, Topic] = {}
        given: dict[int, list[tuple[int, bytes]]] = {}
        waiting = 0
        try:
            for number, time, data in _rows_of(file, known, topics):
                times.append(time)
                if data is None:
                    continue
                self._give(known[number], time, UNKNOWN, data)
                given.setdefault(number, []).append((time, data))
                waiting += 1
                if waiting >= _ROWS:
                    self._add_rows(known, given)
                    waiting = 0
        except _Unreadable as error:
            what = f'its SQLite storage cannot be read ({error})'
            if not times:
                raise BagError(called, what, REMEDY) from None
            self.warnings.append(f'{called}: {what}: used {len(times)} messages before that')
        self.topics |= {_absolute(topic.name) for topic in known.values()}
        self._add_rows(known, given)
        self._look_through(times)

    def _add_rows(
        self, known: Mapping[int, Topic], given: dict[int, list[tuple[int, bytes]]]
    ) -> None:
        """Take messages of an SQLite file, by number of the topic time and bytes; forget them."""
        for number, messages in given.items():
            contents = [data for _, data in messages]
            times = np.array([time for time, _ in messages], dtype=np.int64)
            heads = np.frombuffer(b''.join(
                data[:_STAMP] if len(data) >= _STAMP else _SHORT for data in contents),
                dtype=np.uint8).reshape(-1, _STAMP)
            self._add(known[number], times, np.full(len(times), UNKNOWN), heads,
                      contents.__getitem__)
        given.clear()

    def _called(self, file: Path) -> str:
        return self.name if str(file) == self.path else str(file)

    def _look_through(self, times: Sequence[int]) -> None:
        """Store the arrivals of a file's messages."""
        self.count += len(times)
        every = np.asarray(times)
        possible = every[(every >= 0) & (every < NEVER)].astype(np.int64)
        self._impossible += len(times) - len(possible)
        back = int((possible[:-1] - possible[1:]).max(initial=0))
        if SET_BACK_NS <= back < FAR_NS:
            self.warnings.append(
                f'{self.name}: the clock was set back by {back / 1e9:.1f} s while it was '
                'recorded: messages from before and after that are judged as if they were from '
                'one time')
        self._times.append(possible)

    @property
    def start(self) -> int | None:
        """Return the first arrival of any message, ns; None without any."""
        return self.stretches[0][0] if self.stretches else None

    @property
    def end(self) -> int | None:
        """Return the last arrival of any message, ns; None without any."""
        return self.stretches[-1][1] if self.stretches else None

    def _add(self, topic: Topic, arrival: Ints, published: Ints, heads: Any,
             content: Callable[[int], bytes]) -> None:
        """
        Take messages of a topic.

        :param heads: their first bytes; those of messages that are too short for a stamp are 255.
        :param content: returns all bytes of one of them.
        """
        possible = np.flatnonzero((arrival >= 0) & (arrival < NEVER))
        if not len(possible):
            return
        name = _absolute(topic.name)
        stamps = self.stamps.get(name)
        if stamps is None:
            stamps = self.stamps[name] = Stamps()
            stamps.type = topic.message_type
        different = (published > 0) & (published < NEVER) & (published != arrival)
        headers = self._headers(topic, heads, content)
        for column, values in ((stamps.arrival, arrival), (stamps.header, headers),
                               (stamps.published, np.where(different, published, UNKNOWN))):
            column.frombytes(values[possible].tobytes())

    def _give(self, topic: Topic, arrival: int, published: int, data: bytes) -> None:
        """Give a message to who keeps it."""
        if self._keep is not None and 0 <= arrival < NEVER:
            if data.startswith(ZSTD):
                data = _unpacked_message(data, _MESSAGE_LIMIT)
            self._keep(topic._replace(name=_absolute(topic.name)), arrival, published, data)

    def _headers(self, topic: Topic, heads: Any, content: Callable[[int], bytes]) -> Ints:
        """Return the stamps at the beginning of messages; `UNKNOWN` where there is none."""
        key = (topic.message_type, topic.definition)
        stamped = self._stamped.get(key)
        if stamped is None:
            self._definitions += len(topic.definition)
            if self._definitions > _DEFINITIONS_LIMIT:
                raise BagError(self.name, 'the definitions of its message types are too large',
                               REMEDY)
            stamped = self._stamped[key] = topic.encoding == 'cdr' and _is_stamped(topic)
        if not stamped:
            return np.full(len(heads), UNKNOWN)
        # compressed message by message
        packed = np.flatnonzero((heads[:, :len(ZSTD)] == np.frombuffer(ZSTD, 'u1')).all(axis=1))
        if len(packed):
            heads = heads.copy()
            for number in packed.tolist():
                head = _unpacked_message(content(number), _STAMP)
                heads[number] = np.frombuffer(
                    head if len(head) == _STAMP else b'\1'.ljust(_STAMP), 'u1')
        times = np.ascontiguousarray(heads[:, 4:])
        found = np.full(len(heads), UNKNOWN)
        for order, kind in ((0, '>'), (1, '<')):
            rows = times.view([('s', f'{kind}i4'), ('ns', f'{kind}u4')]).reshape(-1)
            seconds, nanoseconds = rows['s'].astype(np.int64), rows['ns'].astype(np.int64)
            usable = (heads[:, 0] == 0) & (heads[:, 1] == order) & (seconds >= 0) & (
                nanoseconds < 1_000_000_000)
            found[usable] = seconds[usable] * 1_000_000_000 + nanoseconds[usable]
        return found


def _absolute(topic: str) -> str:
    return topic if topic.startswith('/') else f'/{topic}'


def _named_files(metadata: Path) -> tuple[list[str], int | None]:
    """
    Return the names of a bag's files, and how many messages they have, if that is stated.

    Names outside of its folder are ignored.
    """
    try:
        if metadata.stat().st_size > _METADATA_LIMIT:
            raise ValueError('it is too large')
        about = plain(parse_yaml(metadata.read_text(encoding='utf-8'), str(metadata)))
        if about is None:
            raise ValueError('it is empty')
        about = about.get(_ABOUT) if isinstance(about, dict) else None
        about = about if isinstance(about, dict) else {}
        names = about.get('relative_file_paths')
        if not names or not isinstance(names, list) or not all(
                isinstance(name, str) for name in names):
            raise ValueError('it names no file')
        count = about.get('message_count')
        return [*dict.fromkeys(map(os.path.basename, names))], (
            int(count) if isinstance(count, str) and count.isdecimal() else None)
    except (OSError, ValueError, GraphError) as error:
        what = error.problem if isinstance(error, GraphError) else ' '.join(str(error).split())
        raise BagError(
            str(metadata), f'this is not the metadata of a bag ({what[:200]})', REMEDY) from None


@contextmanager
def _unpacked(file: Path) -> Iterator[tuple[Path, bytes]]:
    """Yield a file, unpacked if it is compressed, and the first bytes of its kind."""
    kind = kind_of(file)
    log = Path(f'{file}-wal')
    if kind == SQLITE and log.is_file() and log.stat().st_size:
        raise BagError(str(file), f'its last messages are in {log.name} (the recorder was killed)',
                       'let ros2 bag reindex repair the bag')
    if kind != ZSTD:
        yield file, kind
        return
    with tempfile.TemporaryDirectory(prefix='mddag-') as folder:
        target = Path(folder, 'bag')
        try:
            with open(file, 'rb') as packed, open(target, 'wb') as out:
                _unpack(packed, out, file)
        except zstandard.ZstdError as error:
            raise BagError(str(file), f'cannot be unpacked ({error})', REMEDY) from None
        except OSError as error:
            raise BagError(
                str(file), f'cannot be unpacked into {tempfile.gettempdir()} ({error.strerror})',
                'free space, or name another folder in TMPDIR') from None
        yield target, kind_of(target)


def _unpack(packed: BinaryIO, out: BinaryIO, file: Path) -> None:
    """Unpack a file; raise BagError if it is made to fill the disk."""
    most = max(_UNPACKED_LIMIT, _MOST_TIMES * os.fstat(packed.fileno()).st_size)
    size = 0
    with zstandard.ZstdDecompressor(max_window_size=_WINDOW).stream_reader(
            packed, read_across_frames=True) as reader:
        while piece := reader.read(_PIECE):
            size += len(piece)
            if size > most:
                raise BagError(
                    str(file), f'unpacked it is more than {_MOST_TIMES} times as large, as no '
                    'recording is', REMEDY)
            out.write(piece)


def _unpacked_message(data: bytes, size: int) -> bytes:
    """Return a decompressed message, at most ``size`` bytes; empty if it is damaged."""
    try:
        packed = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
        return bytes(packed.stream_reader(io.BytesIO(data)).read(size))
    except zstandard.ZstdError:
        return b''


class _Unreadable(Exception):
    """An SQLite file that is damaged, or that ros2 bag did not write."""


def _rows_of(
    file: Path, known: dict[int, Topic], topics: Collection[str]
) -> Iterator[tuple[int, int, bytes | None]]:
    """
    Yield the messages of an SQLite file: number of the topic, arrival, content if it is wanted.

    :param known: receives the topics by number; ``topics``: absolute names of the wanted ones.
    :raises _Unreadable: at the first message that cannot be read.
    """
    steps = None
    try:
        size = left = os.stat(file).st_size
        steps = _Steps(size)
        # immutable: reading must not write next to the file
        with closing(sqlite3.connect(
                f'{file.absolute().as_uri()}?immutable=1', uri=True)) as storage:
            storage.set_progress_handler(steps, _SOME_STEPS)
            _check_schema(storage)
            known.update(_topics_of(storage, size))
            wanted = [number for number, topic in known.items()
                      if _absolute(topic.name) in topics]
            for number, time, data in storage.execute(
                    'SELECT topic_id, timestamp, CASE WHEN topic_id IN '
                    f'({", ".join("?" * len(wanted))}) THEN data END '
                    'FROM messages ORDER BY id', wanted):
                if not isinstance(time, int):
                    raise ValueError('the time of a message is none')
                if not (data is None or isinstance(data, bytes)):
                    raise ValueError('the content of a message is none')
                left -= len(data or b'')
                if left < 0:
                    raise ValueError('its messages are larger than itself')
                yield number, time, data
    except Exception as error:      # of SQLite, or caused by damaged data
        reason = ' '.join(str(error).split())
        if steps is not None and steps.left < 0:
            reason = 'it would take longer than any bag of its size'
        raise _Unreadable(reason) from None


class _Steps:
    """Ends a query that takes longer than any in a bag of this size can (in bytes)."""

    def __init__(self, size: int) -> None:
        self.left = _STEPS + _STEPS_A_BYTE * size

    def __call__(self) -> bool:
        self.left -= _SOME_STEPS
        return self.left < 0


def _check_schema(storage: sqlite3.Connection) -> None:
    """Raise ValueError if a file computes what is read from it, which could take for ever."""
    storage.execute('PRAGMA trusted_schema = OFF')
    odd = storage.execute(
        "SELECT name FROM sqlite_master WHERE type = 'view' OR sql LIKE 'CREATE VIRTUAL%'"
    ).fetchall()
    if odd:
        raise ValueError('it has views, which ros2 bag does not write')
    for table in ('messages', 'topics', 'message_definitions'):
        if any(column[-1] for column in storage.execute(f'PRAGMA table_xinfo({table})')):
            raise ValueError('it has computed columns, which ros2 bag does not write')


def _topics_of(storage: sqlite3.Connection, size: int) -> dict[int, Topic]:
    """
    Return the topics of an SQLite file by number; before Iron it has no definitions.

    :param size: of the file
    :raises ValueError: if there is more in it than fits into the file
    """
    definitions: dict[str, tuple[str, str]] = {}
    if storage.execute('PRAGMA table_info(message_definitions)').fetchall():
        for kind, encoding, text in storage.execute(
                'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
                ):
            definitions[kind] = encoding, text
            size -= len(kind) + len(text)
            if size < 0:
                raise ValueError('its definitions are larger than itself')
    topics: dict[int, Topic] = {}
    for number, name, kind, encoding in storage.execute(
            'SELECT id, name, type, serialization_format FROM topics'):
        topics[number] = Topic(name, encoding, kind, *definitions.get(kind, ('', '')))
        size -= len(name)
        if size < 0 or len(topics) > _MOST_TOPICS:
            raise ValueError('it has more topics than any bag')
    return topics


def _is_stamped(topic: Topic) -> bool:
    """Return whether messages of a type begin with a header or a time."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores
    try:
        if topic.definition_encoding == 'ros2msg' and topic.definition.strip():
            types = get_types_from_msg(topic.definition, topic.message_type)
        elif topic.definition_encoding == 'ros2idl':
            types = get_types_from_idl(topic.definition)
        else:
            types = get_typestore(Stores.ROS2_JAZZY).fielddefs
        fields = types[topic.message_type][1]
        return bool(fields) and fields[0][1][1] in _STAMPED
    except Exception:   # a type unknown to rosbags, or an unreadable definition
        return False
