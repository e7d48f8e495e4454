# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A script that starts processes of its own, as those do that process images."""

import multiprocessing
import time

import rclpy
from rclpy.node import Node


def square(number):
    return number * number


def main():
    fork = multiprocessing.get_context('fork')
    for method in (fork, multiprocessing.get_context('spawn')):
        with method.Pool(2) as pool:
            print(method.get_start_method(), pool.map(square, range(4)), flush=True)
    sleepers = [fork.Process(target=time.sleep, args=(60.0,)) for _ in range(10)]
    for each in sleepers:
        each.start()
        each.terminate()
    for each in sleepers:
        each.join(30.0)
    print('ended by', {each.exitcode for each in sleepers}, flush=True)
    for each in sleepers:
        each.kill()
    rclpy.init()
    node = Node('pools')
    node.create_timer(0.01, lambda: None)
    rclpy.spin_once(node)
    rclpy.shutdown()


if __name__ == '__main__':
    main()
