# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which client has sent a request: the id of a client, and the id in the header of a request.

The middleware gives each client an id, and writes it into the requests of the client.  rclpy and
rmw do not show both of these ids, so they are read where they are in memory.  The memory next to
each is compared with values that rclpy or rmw show.  If these differ, the id is unknown, and the
request inherits nothing.

* The id in a request is in its header (``rmw_service_info_t``).  This is a C++ object to which
  the first word after the head of rclpy's Python object refers, as in all objects of pybind11.
  Its other fields must be those that rclpy shows.
* A client of Fast DDS writes the id of the reader of its responses into its requests.  In Kilted
  rmw shows the id of the reader.  In Jazzy rmw shows the id of the client's writer, and the id of
  the reader follows it in ``CustomClientInfo`` of rmw_fastrtps.  Both ids must be of one
  participant.

This also uses ``pointer`` of the handles of clients and services.  Seen in rclpy 7.1 and 9.1.
"""

from __future__ import annotations

import ctypes
from typing import Any

_ID_SIZE, _PARTICIPANT_SIZE = 16, 12
_INFO_SIZE = 208
"""How much of ``CustomClientInfo`` is searched: not more than there is."""
_READER_KIND = 4
"""The last byte of the id of a reader of a topic without keys."""

_rcl = ctypes.CDLL('librcl.so')  # rclpy has loaded it, and with it the middleware's interface
_rmw_client = _rcl.rcl_client_get_rmw_handle
_rmw_client.argtypes = [ctypes.c_void_p]
_rmw_client.restype = ctypes.c_void_p
_id_of_writer = _rcl.rmw_get_gid_for_client
_id_of_writer.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
_id_of_writer.restype = ctypes.c_int


class _Gid(ctypes.Structure):
    """``rmw_gid_t``."""

    _fields_ = (('implementation', ctypes.c_char_p), ('data', ctypes.c_ubyte * _ID_SIZE))


class _Client(ctypes.Structure):
    """``rmw_client_t``."""

    _fields_ = (
        ('implementation', ctypes.c_char_p), ('data', ctypes.c_void_p),
        ('service_name', ctypes.c_char_p))


class _ServiceInfo(ctypes.Structure):
    """``rmw_service_info_t``."""

    _fields_ = (
        ('source_timestamp', ctypes.c_int64), ('received_timestamp', ctypes.c_int64),
        ('client', ctypes.c_ubyte * _ID_SIZE), ('sequence_number', ctypes.c_int64))


_service_name = _rcl.rcl_service_get_service_name
_service_name.argtypes = [ctypes.c_void_p]
_service_name.restype = ctypes.c_char_p


def name_of_service(handle: Any) -> str:
    """Return the name of the service with a handle, which is entered."""
    name: bytes | None = _service_name(handle.pointer)
    return '' if name is None else name.decode()


def id_of_client(handle: Any) -> tuple[bytes, str] | None:
    """
    Return the id in the requests of a client, and the name of the service; None: unknown.

    :param handle: the client's, which is entered.
    """
    gid = _Gid()
    address = _rmw_client(handle.pointer)
    if address is None or _id_of_writer(address, ctypes.byref(gid)) != 0:
        return None
    client = _Client.from_address(address)
    if not client.implementation.startswith(b'rmw_fastrtps'):
        return None
    shown = reader = bytes(gid.data)
    if shown[-1] != _READER_KIND:
        memory = ctypes.string_at(client.data, _INFO_SIZE)
        place = memory.find(shown) + _ID_SIZE
        reader = memory[place:place + _ID_SIZE]
        if place < _ID_SIZE or len(reader) < _ID_SIZE or reader[-1] != _READER_KIND or (
                reader[:_PARTICIPANT_SIZE] != shown[:_PARTICIPANT_SIZE]):
            return None
    return reader, client.service_name.decode()


def sender_of(header: Any) -> bytes | None:
    """Return the id of the client that has sent the request with a header, if known."""
    address = ctypes.c_void_p.from_address(id(header) + object.__basicsize__).value
    if address is None:
        return None
    info = _ServiceInfo.from_address(address)
    if (info.source_timestamp, info.received_timestamp, info.sequence_number) != (
            header.source_timestamp, header.received_timestamp,
            header.request_id.sequence_number):
        return None
    return bytes(info.client)
