# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The parts of an executor that tests look into: their private names are here only."""


def pool_of(executor):
    """Return its worker threads, with their lock and what is due: see ``workers.WorkerPool``."""
    return executor._pool


def engine_of(executor):
    """Return what decides in it, with the core's state: see ``engine.Engine``."""
    return executor._engine


def replace_method(patch, owner, name, function):
    """Replace a method of one object, whose class has slots; ``patch``: pytest's monkeypatch."""
    kind = type(owner)
    method = getattr(kind, name)
    patch.setattr(kind, name, lambda self, *args, **more: (
        function(*args, **more) if self is owner else method(self, *args, **more)))


def at_once_of(executor):
    """Return what its spinning thread handles itself: see ``at_once.AtOnce``."""
    return executor._at_once


def registry_of(executor):
    """Return the entities that it knows: see ``registry.Registry``."""
    return executor._registry


def functions_of_tasks(executor):
    """Return the records of the functions that have been tasks: see ``tasks.TaskEntities``."""
    return list(executor._task_entities._entities.values())
