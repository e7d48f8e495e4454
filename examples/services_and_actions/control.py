# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A service and an action next to a control loop with a deadline, all on one executor.

    python examples/services_and_actions/control.py

A callback that waits in a synchronous service call lends its worker to a spare thread until the
answer is there, so it can't block the answer, even with one worker.
"""

from pathlib import Path
import time

from mddag_executor import MultiDeadlineExecutor
import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header
from std_srvs.srv import Trigger

try:
    from example_interfaces.action import Fibonacci
except ImportError:  # not on the package index; this one has the same fields
    from test_msgs.action import Fibonacci


def control() -> list[Node]:
    """Return the nodes of the declared DAG."""
    sensor, controller = Node('sensor'), Node('controller')
    state = sensor.create_publisher(Header, '/state', 10)
    sensor.create_timer(0.02, lambda: state.publish(Header()))
    controller.create_subscription(Header, '/state', lambda message: time.sleep(0.002), 10)
    return [sensor, controller]


class Servers(Node):
    """Answer a service at leisure, and count for an action."""

    def __init__(self) -> None:
        super().__init__('servers')
        self.create_service(Trigger, 'calibrate', self.calibrate)
        self._action = ActionServer(
            self, Fibonacci, 'count', self.count, callback_group=MutuallyExclusiveCallbackGroup())

    def calibrate(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        time.sleep(0.1)
        response.success, response.message = True, 'calibrated'
        return response

    def count(self, goal):
        sequence = [0, 1]
        while len(sequence) < goal.request.order:
            time.sleep(0.02)
            sequence.append(sequence[-1] + sequence[-2])
            goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
        goal.succeed()
        return Fibonacci.Result(sequence=sequence)


class Operator(Node):
    """Call the service and wait for it, then send the goal."""

    def __init__(self) -> None:
        super().__init__('operator')
        self.done = rclpy.Future()
        self._calibrate = self.create_client(
            Trigger, 'calibrate', callback_group=MutuallyExclusiveCallbackGroup())
        self._count = ActionClient(
            self, Fibonacci, 'count', callback_group=MutuallyExclusiveCallbackGroup())
        self._start = self.create_timer(0.1, self.start)

    def start(self) -> None:
        if not (self._calibrate.service_is_ready() and self._count.server_is_ready()):
            return
        self._start.cancel()
        answer = self._calibrate.call(Trigger.Request())  # waits within a callback
        print(f'service: {answer.message}', flush=True)
        goal = self._count.send_goal_async(
            Fibonacci.Goal(order=12), feedback_callback=lambda feedback: None)
        goal.add_done_callback(
            lambda handle: handle.result().get_result_async().add_done_callback(self.finish))

    def finish(self, result) -> None:
        print(f'action: {list(result.result().result.sequence)}', flush=True)
        self.done.set_result(True)


def main() -> None:
    rclpy.init()
    executor = MultiDeadlineExecutor(str(Path(__file__).with_name('graph.yaml')))
    operator = Operator()
    for node in (*control(), Servers(), operator):
        executor.add_node(node)
    executor.spin_until_future_complete(operator.done, 30.0)
    executor.shutdown()
    statistics = executor.statistics()
    sink = statistics['dags']['control']['sinks']['/controller:step']
    print(f"control: {sink['completed']} steps, {sink['late']} late; "
          f"{statistics['undeclared']} undeclared callbacks")


if __name__ == '__main__':
    main()
