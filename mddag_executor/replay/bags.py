# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The stamps in ordinary rosbag2 recordings: arrival times and header stamps of messages.

Theory of operation
-------------------
* A bag is a folder with `metadata.yaml` and the files that it names, or one such file.  The first
  bytes of a file, not its name, say its kind: MCAP (read with ``trace.TraceReader``), SQLite (read
  with rosbags) or zstd around one of them (a file-compressed bag, unpacked to a temporary file). A
  write-ahead log next to an SQLite file belongs to it.
* A message has its arrival (log time), its publication if the recorder stored it separately, and
  the stamp at the beginning of its content, if its type begins with a `std_msgs/Header` or a time.
  The rest is not decoded.
* A topic with a relative name (`AAA`) is the same as in the root namespace (`/AAA`).
* Messages at impossible times (``trace.times``) are dropped and counted.
* Damage loses the rest of its file, and is reported.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager
import io
import os
from pathlib import Path
import re
import shutil
import sqlite3
import struct
import tempfile
from typing import Any

from mddag_executor.errors import InputError
from mddag_executor.text import counted
from mddag_executor.trace import TraceError, TraceReader
from mddag_executor.trace.channels import Topic
from mddag_executor.trace.errors import renamed
from mddag_executor.trace.times import joined, NEVER, stretches
import zstandard

_METADATA_LIMIT = 4 * 1024 * 1024
_MCAP, _SQLITE, _ZSTD = b'\x89MCAP0\r\n', b'SQLite format 3\0', b'\x28\xb5\x2f\xfd'
_REMEDY = 'give a folder with metadata.yaml that ros2 bag record wrote, or one of its files'
_SPARE = 1 << 30            # bytes of disk space that unpacking leaves free
_MOST_TIMES = 1000
_PIECE = 1 << 20
_BAG_FILE = re.compile(r'metadata\.yaml|.*\.(mcap|db3)(\.zstd)?')
_STAMP = 12                 # bytes: encapsulation, seconds, nanoseconds
_WINDOW = 128 * 1024 * 1024
_STAMPED = {
    'std_msgs/Header', 'std_msgs/msg/Header', 'Header', 'builtin_interfaces/Time',
    'builtin_interfaces/msg/Time'}
UNKNOWN = -1
"""A stamp that a message does not have."""


class BagError(InputError):
    """A bag that cannot be used; its text is `FILE: what is wrong: what to do`."""


class Stamps:
    """The messages of a topic, in the order of the bag: times in ns, `UNKNOWN` if missing."""

    def __init__(self) -> None:
        self.arrival = array('q')
        self.published = array('q')
        self.header = array('q')
        self.type = ''


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
        self.topics: set[str] = set()
        self.stamps: dict[str, Stamps] = {}
        self.stretches: list[tuple[int, int]] = []
        self._impossible = 0
        self.warnings: list[str] = []
        self._stamped: dict[tuple[str, str], bool] = {}
        self._stated: int | None = None     # number of messages according to metadata.yaml
        files = self._files()
        for file in files:
            self._read(file, topics, len(files) == 1)
        if self._impossible:
            self.warnings.append(
                f'{self.name}: left out: {counted(self._impossible, "message")} at an impossible '
                'time')
        if self._stated is not None and self._stated != self.count and not self.warnings:
            self.warnings.append(
                f'{self.name}: metadata.yaml counts {counted(self._stated, "message")}, but '
                f'there are {self.count}')

    def _files(self) -> list[Path]:
        path = Path(self.path)
        if not path.is_dir():
            return [path]
        metadata = path / 'metadata.yaml'
        if not metadata.is_file():
            found = sorted(
                (p for p in path.iterdir() if _BAG_FILE.fullmatch(p.name)), key=_natural)
            found = [p for p in found if p.name != 'metadata.yaml']
            if not found:
                raise BagError(self.name, 'there is neither metadata.yaml nor a bag file', _REMEDY)
            self.warnings.append(
                f'{self.name}: metadata.yaml is missing (the recorder was killed): used '
                f'{counted(len(found), "bag file")} from the folder')
            return found
        names, self._stated = _named_files(metadata)
        there = [path / name for name in names if (path / name).is_file()]
        if not there:
            raise BagError(
                str(metadata), 'none of the bag files that it names is there', 'copy them, too')
        if len(there) < len(names):
            self.warnings.append(
                f'{self.name}: {len(names) - len(there)} of {counted(len(names), "file")} are '
                'missing: what they held is not replayed')
        return there

    def _read(self, file: Path, topics: Collection[str], only: bool) -> None:
        try:
            with _unpacked(file) as (unpacked, kind):
                if kind == _MCAP:
                    self._read_mcap(unpacked, file, topics)
                elif kind == _SQLITE:
                    self._read_sqlite(unpacked, file, topics)
                else:
                    raise BagError(str(file), 'is no rosbag2 recording', _REMEDY)
        except (BagError, TraceError) as error:
            if only:
                raise type(error)(
                    self.name if error.file == self.path else error.file, error.problem,
                    error.remedy) from None
            self.warnings.append(f'{file}: {error.problem}: it is left out')

    def _read_mcap(self, unpacked: Path, file: Path, topics: Collection[str]) -> None:
        try:
            reader = TraceReader(unpacked)
            relative = {topic[1:] for topic in topics}
            for topic, log_time, publish_time, data in reader.messages({*topics, *relative}):
                self._add(topic, log_time, publish_time, data)
        except TraceError as error:
            raise BagError(str(file), error.problem, error.remedy) from None
        self.warnings += [
            renamed(text, reader.path, self._called(file)) for text in reader.warnings]
        self.topics |= {_absolute(topic.name) for topic in reader.topics.values()}
        self.count += len(reader.times)
        self._look_through(reader.times)

    def _read_sqlite(self, unpacked: Path, file: Path, topics: Collection[str]) -> None:
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
        used = 0
        try:
            reader = Sqlite3Reader(unpacked)
            reader.open()
            try:
                self.topics |= {_absolute(c.topic) for c in reader.connections}
                count = reader.metadata.message_count
                self.count += count
                known = {c.id: _topic_of(c) for c in reader.connections
                         if _absolute(c.topic) in topics}
                wanted = [c for c in reader.connections if c.id in known]
                for connection, time, data in reader.messages(wanted) if wanted else ():
                    self._add(known[connection.id], time, UNKNOWN, data)
                    used += 1
            finally:
                reader.close()
                self._look_through(_sqlite_times(unpacked))
        except Exception as error:      # of SQLite, of rosbags, or caused by damaged data
            what = f'its SQLite storage cannot be read ({" ".join(str(error).split())})'
            if not used:
                raise BagError(str(file), what, _REMEDY) from None
            self.warnings.append(
                f'{self._called(file)}: {what}: used {used} messages before that')

    def _called(self, file: Path) -> str:
        return self.name if str(file) == self.path else str(file)

    def _look_through(self, times: Sequence[int]) -> None:
        """Store the arrivals of a file's messages."""
        possible = [time for time in times if 0 <= time < NEVER]
        self._impossible += len(times) - len(possible)
        self.stretches = joined([*self.stretches, *stretches(possible)])

    @property
    def start(self) -> int | None:
        """Return the first arrival of any message, ns; None without any."""
        return self.stretches[0][0] if self.stretches else None

    @property
    def end(self) -> int | None:
        """Return the last arrival of any message, ns; None without any."""
        return self.stretches[-1][1] if self.stretches else None

    def _add(self, topic: Topic, arrival: int, published: int, data: bytes) -> None:
        if not 0 <= arrival < NEVER:
            return
        name = _absolute(topic.name)
        stamps = self.stamps.get(name)
        if stamps is None:
            stamps = self.stamps[name] = Stamps()
            stamps.type = topic.message_type
        if self._keep is not None:
            content = data
            if content.startswith(_ZSTD):
                content = _unpacked_message(content, _SPARE)
            self._keep(topic._replace(name=name), arrival, published, content)
        stamps.arrival.append(arrival)
        different = 0 < published < NEVER and published != arrival
        stamps.published.append(published if different else UNKNOWN)
        stamps.header.append(self._header(topic, data))

    def _header(self, topic: Topic, data: bytes) -> int:
        key = (topic.message_type, topic.definition)
        stamped = self._stamped.get(key)
        if stamped is None:
            stamped = self._stamped[key] = topic.encoding == 'cdr' and _is_stamped(topic)
        if not stamped:
            return UNKNOWN
        head = data[:_STAMP]
        if head.startswith(_ZSTD):      # compressed message by message
            head = _unpacked_message(data, _STAMP)
        if len(head) < _STAMP or head[0] or head[1] > 1:
            return UNKNOWN
        seconds, nanoseconds = struct.unpack('<iI' if head[1] else '>iI', head[4:])
        if seconds < 0 or nanoseconds >= 1_000_000_000:
            return UNKNOWN
        return int(seconds * 1_000_000_000 + nanoseconds)


def is_ordinary(path: str) -> bool:
    """Return whether a path is a bag without traced events, so without jobs."""
    if not os.path.isdir(path):
        return _is_bag(path)
    names = [name for name in os.listdir(path) if _BAG_FILE.fullmatch(name)]
    files = [os.path.join(path, name) for name in names if name != 'metadata.yaml']
    return all(opened_trace(file) is None for file in files) and (
        'metadata.yaml' in names or any(map(_is_bag, files)))


def opened_trace(path: str) -> TraceReader | None:
    """Return the trace in a file; None for other files, and for damage."""
    reader = _mcap(path)
    return reader if reader is not None and _has_trace(reader) else None


def _is_bag(path: str) -> bool:
    reader = _mcap(path)
    try:
        return _kind(Path(path)) in (_SQLITE, _ZSTD) if reader is None else not _has_trace(reader)
    except InputError:
        return False


def _mcap(path: str) -> TraceReader | None:
    try:
        return TraceReader(path)
    except (InputError, OSError):
        return None     # another kind, or damaged: the reader reports the reason


def _has_trace(reader: TraceReader) -> bool:
    return reader.written_here or reader.has_events()


def _absolute(topic: str) -> str:
    return topic if topic.startswith('/') else f'/{topic}'


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r'(\d+)', path.name)]


def _named_files(metadata: Path) -> tuple[list[str], int | None]:
    """
    Return the names of a bag's files and the number of messages in them.

    Names outside of its folder are ignored.
    """
    import yaml
    try:
        if metadata.stat().st_size > _METADATA_LIMIT:
            raise ValueError('it is too large')
        about = yaml.safe_load(metadata.read_text(encoding='utf-8'))
        about = about['rosbag2_bagfile_information']
        names = [os.path.basename(name) for name in about['relative_file_paths']]
        if not names:
            raise ValueError('it names no file')
        count = about.get('message_count')
        return names, count if isinstance(count, int) else None
    except (OSError, ValueError, TypeError, KeyError, AttributeError,
            RecursionError, yaml.YAMLError) as error:
        what = ' '.join(str(error).split())[:200]
        raise BagError(str(metadata), f'this is no metadata of a bag ({what})', _REMEDY) from None


@contextmanager
def _unpacked(file: Path) -> Iterator[tuple[Path, bytes]]:
    """
    Yield a readable file and the first bytes of its kind.

    A zstd file is unpacked.  An SQLite file with a write-ahead log, which a killed recorder
    leaves, is copied, because reading the log changes the file.
    """
    kind, log = _kind(file), Path(f'{file}-wal')
    has_log = kind == _SQLITE and log.is_file() and log.stat().st_size > 0
    if kind != _ZSTD and not has_log:
        yield file, kind
        return
    with tempfile.TemporaryDirectory(prefix='mddag-') as folder:
        target = Path(folder, 'bag')
        try:
            if has_log:
                _copy_with_log(file, log, target)
            else:
                _unpack(file, target)
        except (zstandard.ZstdError, sqlite3.Error) as error:
            raise BagError(str(file), f'cannot be unpacked ({error})', _REMEDY) from None
        except OSError as error:
            raise BagError(
                str(file), f'cannot be unpacked ({error.strerror})', 'free space') from None
        yield target, _kind(target)


def _unpack(file: Path, target: Path) -> None:
    with open(file, 'rb') as packed, open(target, 'wb') as out:
        reader = zstandard.ZstdDecompressor(max_window_size=_WINDOW).stream_reader(packed)
        while piece := reader.read(_PIECE):
            if out.tell() > _SPARE and out.tell() > _MOST_TIMES * packed.tell():
                raise BagError(
                    str(file), f'it unpacks to more than {_MOST_TIMES} times its size',
                    'unpack it yourself if you trust it')
            _check_space(file, target, len(piece))
            out.write(piece)


def _copy_with_log(file: Path, log: Path, target: Path) -> None:
    """Copy a database, and apply its write-ahead log to the copy."""
    _check_space(file, target, file.stat().st_size + 2 * log.stat().st_size)
    shutil.copyfile(file, target)
    shutil.copyfile(log, f'{target}-wal')
    with closing(sqlite3.connect(target)) as storage:
        storage.execute('PRAGMA wal_checkpoint(TRUNCATE)')


def _check_space(file: Path, target: Path, size: int) -> None:
    if shutil.disk_usage(target.parent).free < _SPARE + size:
        raise BagError(
            str(file), f'unpacked it does not fit into {tempfile.gettempdir()}',
            'free space, or name another folder in TMPDIR')


def _kind(file: Path) -> bytes:
    """Return the first bytes of a file if they are those of a known kind."""
    try:
        if not file.is_file():
            raise BagError(str(file), 'is no file', _REMEDY)
        with open(file, 'rb') as stream:
            head = stream.read(16)
    except OSError as error:
        raise BagError(str(file), f'cannot be read ({error.strerror})', _REMEDY) from None
    except ValueError:
        raise BagError(str(file), 'is no file name', _REMEDY) from None
    return next((kind for kind in (_MCAP, _SQLITE, _ZSTD) if head.startswith(kind)), b'')


def _unpacked_message(data: bytes, size: int) -> bytes:
    """Return a decompressed message, at most ``size`` bytes; empty if it is damaged."""
    try:
        packed = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
        return bytes(packed.stream_reader(io.BytesIO(data)).read(size))
    except zstandard.ZstdError:
        return b''


def _sqlite_times(file: Path) -> list[int]:
    """Return the arrivals of messages in the order of storage, as far as readable."""
    times: list[int] = []
    with closing(sqlite3.connect(f'{file.absolute().as_uri()}?mode=ro', uri=True)) as storage:
        try:
            for time, in storage.execute('SELECT timestamp FROM messages ORDER BY id'):
                times.append(int(time))
        except (sqlite3.Error, TypeError, ValueError):
            pass        # the reader of the messages reports the reason
    return times


def _topic_of(connection: Any) -> Topic:
    definition = connection.msgdef
    encoding = {'MSG': 'ros2msg', 'IDL': 'ros2idl'}.get(definition.format.name, '')
    return Topic(
        connection.topic, connection.ext.serialization_format, connection.msgtype, encoding,
        definition.data)


def _is_stamped(topic: Topic) -> bool:
    """Return whether messages of a type begin with a header or a time."""
    if topic.definition_encoding == 'ros2msg' and topic.definition.strip():
        for line in topic.definition.splitlines():
            words = line.split('#')[0].split()
            if words[:1] and words[0].startswith('==='):
                return False
            if len(words) == 2 and '=' not in words[1]:
                return words[0] in _STAMPED
            if len(words) > 2 and '=' not in line:
                return words[0] in _STAMPED     # with a default value
        return False
    try:
        from rosbags.typesys import get_types_from_idl, get_typestore, Stores
        if topic.definition_encoding == 'ros2idl':
            fields = get_types_from_idl(topic.definition)[topic.message_type][1]
        else:
            fields = get_typestore(Stores.ROS2_JAZZY).fielddefs[topic.message_type][1]
        return bool(fields) and fields[0][1][1] in _STAMPED
    except Exception:   # a type unknown to rosbags, or an unreadable definition
        return False
