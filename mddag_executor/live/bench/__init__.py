# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Measure executors of rclpy nodes side by side: this one and those of rclpy.

Theory of operation
-------------------
One measurement is a ``Spec``.  ``campaign`` runs each in a process of its own
(``python -m mddag_executor.live.bench``), one after the other, so that none has another's threads,
caches or nodes beside it; the yardstick is the same for all of them.

There are two families of loads.  *Declared* loads (``autoware``, ``reference-system``) are the
synthetic nodes of a declaration, with the same draw of execution times for every executor; they
ask who keeps deadlines.  *Message* loads (``topics``, ``entities``) are subscriptions with empty
callbacks, whose publishers run in another process so that their cost is not counted; they ask what
a callback costs and how long a message waits.

``dispatch latency`` is the time from a message's source timestamp, which the middleware sets when
it is published, to the first statement of its callback; for a timer, from its nominal due time.
"""
