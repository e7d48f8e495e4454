# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of rclcpp nodes made by hand, in the formats of the ROS distributions."""

from mddag_executor.trace import EventType, TraceFile

MS = 1_000_000
US = 1_000
BEGIN = 1_655_782_980_000_000_000
CAMERA = """\
mddag: 1
nodes:
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]}
  - {node: /detect, callbacks: [{name: run, subscription: /image, deadline: 10ms}]}
"""
_MORE = {
    'ros2:dispatch_subscription_callback': (
        'message', 'callback', 'source_stamp', 'message_timestamp'),
    'ros2_hook:take_type_erased': ('source_stamp', 'message'),
    'ros2:rmw_publish': ('message', 'timestamp_'),
    'ros2:rclcpp_intra_publish': ('publisher_handle', 'message'),
    'ros2:message_construct': ('original_message', 'constructed_message'),
    'ros2:dispatch_intra_process_subscription_callback': (
        'message', 'callback', 'message_timestamp'),
    'ros2:rclcpp_ring_buffer_enqueue': ('buffer', 'index', 'size', 'overwritten'),
    'ros2:rclcpp_ring_buffer_dequeue': ('buffer', 'index', 'size'),
    'ros2_caret:rcl_timer_init': ('timer_handle', 'period', 'init_timestamp'),
    'ros2_caret:dds_bind_addr_to_addr': ('addr_from', 'addr_to'),
    'ros2_hook:dds_write': ('message_addr',),
    'dds:write_pre': ('writer', 'data'),
}
_JAZZY = EventType('ros2_caret', 'dds_write', (
    ('rmw_publisher_handle', 'uint64'), ('message', 'uint64'), ('timestamp_', 'int64')))
STYLES = ('caret', 'fastdds', 'humble_fastdds', 'jazzy', 'tracing', 'rclpy')
"""How a publication is recorded: by CARET with Cyclone DDS, with Fast DDS up to Galactic and from
Humble on, and from Jazzy on; by ros2_tracing from Jazzy on; by CARET in rclpy."""


class Recorded:
    """
    A recording: what happens is added in any order, times are ns since `BEGIN`.

    Handles and callbacks are any numbers that the test picks; `pid` is 1 and threads are as given.
    """

    def __init__(self, path):
        self.path = path
        self._events = []
        self._next_message = 0x7000

    def add(self, name, time, tid, *fields, pid=1):
        self._events.append((BEGIN + time, pid, tid, name, fields))

    def write(self, but=(), stop=None, nameless=()):
        """
        Write the file, without the events at these places in the order of time.

        :param nameless: which of pid and tid the tracer did not record.
        """
        with TraceFile(self.path, overwrite=True) as file:
            file.define(_JAZZY)
            keys = {}
            for name, fields in _MORE.items():
                provider, _, short = name.partition(':')
                keys[name] = file.define(EventType(provider, short, tuple(
                    (field, 'int64' if field.endswith('stamp') else 'uint64')
                    for field in fields)))
            ordered = sorted(self._events, key=lambda event: event[0])
            for place, (time, pid, tid, name, fields) in enumerate(ordered[:stop]):
                if place not in but:
                    file.add(keys.get(name, name), time, 0 if 'pid' in nameless else pid,
                             0 if 'tid' in nameless else tid, *fields)
        return self.path

    def names(self):
        return [event[3] for event in sorted(self._events, key=lambda event: event[0])]

    def times(self):
        return sorted(event[0] - BEGIN for event in self._events)

    # --- who is who ------------------------------------------------------------------------------

    def node(self, handle, name, time=0, pid=1):
        namespace, _, short = name.rpartition('/')
        self.add('ros2:rcl_node_init', time, 1, handle, handle, short, namespace or '/', pid=pid)

    def publisher(self, handle, node, topic, time=0, pid=1):
        self.add('ros2:rcl_publisher_init', time, 1, handle, node, handle, topic, 10, pid=pid)

    def timer(self, callback, node, period, time=0, pid=1):
        """Add a timer; its handle is its callback's number and 10,000."""
        handle = callback + 10_000
        self.add('ros2:rcl_timer_init', time, 1, handle, period, pid=pid)
        self.add('ros2:rclcpp_timer_callback_added', time, 1, handle, callback, pid=pid)
        self.add('ros2:rclcpp_timer_link_node', time, 1, handle, node, pid=pid)

    def subscription(self, callback, node, topic, time=0, pid=1, within=None):
        """Add a subscription: its rmw handle is its callback's number and 30,000."""
        handle = callback + 10_000
        self.add('ros2:rcl_subscription_init', time, 1, handle, node, callback + 30_000, topic, 10,
                 pid=pid)
        self.add('ros2:rclcpp_subscription_init', time, 1, handle, callback + 20_000, pid=pid)
        for each in (callback, within):
            if each is not None:
                self.add('ros2:rclcpp_subscription_callback_added', time, 1, callback + 20_000,
                         each, pid=pid)

    def group(self, address, kind, *callbacks, time=0):
        self.add('ros2_caret:add_callback_group', time, 1, 5, address, kind)
        for entity, callback in callbacks:
            self.add(f'ros2_caret:callback_group_add_{entity}', time, 1, address,
                     callback + 10_000)

    # --- what happens ----------------------------------------------------------------------------

    def run(self, callback, tid, start, end, within=False, pid=1):
        self.add('ros2:callback_start', start, tid, callback, within, pid=pid)
        self.add('ros2:callback_end', end, tid, callback, pid=pid)

    def publish(self, handle, tid, time, stamp=None, style='caret', pid=1, header=0):
        """
        Add a publication and return its source timestamp (ns since `BEGIN`).

        :param style: one of `STYLES`
        """
        self._next_message += 8
        message = self._next_message
        stamp = time + 10 * US if stamp is None else stamp

        def add(name, after, *fields):
            self.add(name, time + after * US, tid, *fields, pid=pid)

        if style == 'tracing':
            add('ros2:rclcpp_publish', 0, 0, message, 0)
        elif style != 'rclpy':
            add('ros2:rclcpp_publish', 0, handle, message, BEGIN + header if header else 0)
        add('ros2:rcl_publish', 5, handle, message)
        if style == 'tracing':
            add('ros2:rmw_publish', 6, message, BEGIN + stamp)
        elif style == 'jazzy':
            add('ros2_caret:dds_write#2', 8, handle, message, BEGIN + stamp)
        else:
            add('ros2_caret:dds_write', 8, message)
            address = message
            if style == 'fastdds':
                address = 0x5550        # of one buffer, again and again
                add('ros2_caret:dds_bind_addr_to_addr', 10, message, address)
            elif style == 'humble_fastdds':
                address = 0
            add('ros2_caret:dds_bind_addr_to_stamp', 20, address, BEGIN + stamp)
        return stamp

    def receive(self, callback, tid, start, end, stamp, style='caret', stated=0, pid=1):
        """Add an execution for a message, as `caret` or `take` records it."""
        if style == 'caret':
            self.add('ros2:dispatch_subscription_callback', start - 4 * US, tid, 0x99, callback,
                     BEGIN + stamp, BEGIN + stated if stated else 0, pid=pid)
        else:
            self.add('ros2:rmw_take', start - 4 * US, tid, callback + 30_000, 0x99, BEGIN + stamp,
                     True, pid=pid)
        self.run(callback, tid, start, end, pid=pid)


def four_jobs(path):
    """Write a recording of /camera and /detect, which a message each 100 ms starts."""
    r = Recorded(path)
    r.node(1, '/camera')
    r.node(2, '/detect')
    r.timer(11, 1, 100 * MS)
    r.publisher(100, 1, '/image')
    r.subscription(12, 2, '/image')
    for k in range(1, 5):
        at = k * 100 * MS
        r.run(11, 1, at, at + 2 * MS)
        stamp = r.publish(100, 1, at + 1 * MS)
        r.receive(12, 2, at + 3 * MS, at + (12 if k == 4 else 5) * MS, stamp)
    return r.write()
