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
    sleeper = fork.Process(target=time.sleep, args=(60.0,))
    sleeper.start()
    sleeper.terminate()
    sleeper.join(30.0)
    print('ended by', sleeper.exitcode, flush=True)
    sleeper.kill()
    rclpy.init()
    node = Node('pools')
    node.create_timer(0.01, lambda: None)
    rclpy.spin_once(node)
    rclpy.shutdown()


if __name__ == '__main__':
    main()
