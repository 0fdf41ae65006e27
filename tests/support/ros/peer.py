# SPDX-License-Identifier: Apache-2.0
"""A ROS node that does what a test asks it: run by the interpreter of `tests.support.ros.environment`.

Standard input has a pickled ``(method, arguments, keywords)`` after another, standard output as many pickled
``(whether it was done, result or error)``.  Messages are dictionaries on both ways, except for what the map
services answer, which is a `Reply`.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pickle
import sys
import threading
import traceback
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile

from tests.support.ros.replies import from_message

_DEPTH = 10  # rclpy's own


def kind(name: str) -> Any:
    """Return the class of a type, ``sensor_msgs/msg/PointCloud2``; ``msg`` may be left out."""
    package, *middle, last = name.split("/")
    return getattr(importlib.import_module(f"{package}.{middle[0] if middle else 'msg'}"), last)


def filled(message: Any, fields: dict[str, Any]) -> Any:
    """Set the fields of a message, and of those in it."""
    for name, value in fields.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            inner = kind(message.get_fields_and_field_types()[name].removeprefix("sequence<").rstrip(">"))
            setattr(message, name, [filled(inner(), one) for one in value])
        else:
            setattr(message, name, value)
    return message


def plain(value: Any) -> Any:
    """Return a message without its classes."""
    if hasattr(value, "get_fields_and_field_types"):
        if hasattr(value, "new_pointcloud_with_ids"):
            return from_message(value)
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if getattr(value, "typecode", "") == "B":
        return bytes(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(one) for one in value] if isinstance(value, list) else value


class Peer:
    """A node, its clients, the requests that they sent, and what it subscribes to; each by a number."""

    def __init__(self, name: str) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(f"peer_{os.getpid()}_{name}", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()
        self._clients: list[Any] = []
        self._sent: list[Any] = []
        self._came: list[list[Any]] = []
        self._publishers: list[Any] = []
        self._timers: dict[int, Any] = {}
        self._subscriptions: list[Any] = []
        self._news = threading.Condition()

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._context.destroy()

    def client(self, type_name: str, name: str, depth: int = _DEPTH) -> int:
        """Make a client of a service."""
        qos = QoSProfile(depth=depth)
        self._clients.append(self._node.create_client(kind(type_name), name, qos_profile=qos))
        return len(self._clients) - 1

    def ready(self, client: int, within_s: float) -> bool:
        """Return whether its service is there, once it is or the time is over."""
        return bool(self._clients[client].wait_for_service(timeout_sec=within_s))

    def servers(self, name: str) -> list[bytes]:
        """Return the ids of the ends of a service's servers: what reads requests, and what writes replies."""
        ends = [
            *self._node.get_subscriptions_info_by_topic(f"rq{name}Request", no_mangle=True),
            *self._node.get_publishers_info_by_topic(f"rr{name}Reply", no_mangle=True),
        ]
        return [bytes(one.endpoint_gid) for one in ends]

    def send(self, clients: list[int], requests: list[dict[str, Any]]) -> list[int]:
        """Send requests by these clients, one after another."""
        first = len(self._sent)
        for client, fields in zip(clients, requests, strict=True):
            one = self._clients[client]
            future = one.call_async(filled(one.srv_type.Request(), fields))
            future.add_done_callback(self._notify)
            self._sent.append(future)
        return list(range(first, len(self._sent)))

    def _notify(self, _future: Any) -> None:
        with self._news:
            self._news.notify_all()

    def answered(self) -> list[int]:
        """Return which requests were answered, in the order that they were sent."""
        return [number for number, future in enumerate(self._sent) if future.done()]

    def receive(self, number: int, within_s: float) -> Any:
        """Return the answer, None where there is none in time."""
        future = self._sent[number]
        with self._news:
            done = self._news.wait_for(future.done, within_s)
        return plain(future.result()) if done else None

    def advertise(self, type_name: str, name: str, latched: bool) -> int:
        """Make a publisher."""
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=10, durability=durability)
        self._publishers.append(self._node.create_publisher(kind(type_name), name, qos))
        return len(self._publishers) - 1

    def publish(self, publisher: int, fields: dict[str, Any]) -> None:
        """Publish a message."""
        one = self._publishers[publisher]
        one.publish(filled(one.msg_type(), fields))

    def repeat(self, publisher: int, fields: dict[str, Any]) -> None:
        """Publish a message twenty times a second, in place of the one before."""
        one = self._publishers[publisher]
        message = filled(one.msg_type(), fields)
        if publisher in self._timers:
            self._node.destroy_timer(self._timers[publisher])
        self._timers[publisher] = self._node.create_timer(0.05, lambda: one.publish(message))

    def rest(self, publisher: int) -> None:
        """Publish a message no longer."""
        self._node.destroy_timer(self._timers.pop(publisher))

    def unsubscribe(self, subscription: int) -> None:
        """Subscribe no longer."""
        self._node.destroy_subscription(self._subscriptions[subscription])

    def subscribe(self, type_name: str, name: str, latched: bool) -> int:
        """Subscribe to a topic."""
        came: list[Any] = []

        def take(message: Any) -> None:
            with self._news:
                came.append(message)
                self._news.notify_all()

        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=10, durability=durability)
        self._subscriptions.append(self._node.create_subscription(kind(type_name), name, take, qos))
        self._came.append(came)
        return len(self._came) - 1

    def message(self, subscription: int, number: int, within_s: float) -> Any:
        """Return one of its messages, None where it does not come in time."""
        messages = self._came[subscription]
        with self._news:
            is_there = self._news.wait_for(lambda: len(messages) > number, within_s)
        return plain(messages[number]) if is_there else None

    def nodes(self) -> list[str]:
        """Return the nodes of the domain."""
        return [f"{space.rstrip('/')}/{name}" for name, space in self._node.get_node_names_and_namespaces()]

    def services_of(self, name: str, namespace: str) -> dict[str, list[str]]:
        """Return a node's services and their types."""
        return dict(self._node.get_service_names_and_types_by_node(name, namespace))

    def published_by(self, name: str, namespace: str) -> dict[str, list[str]]:
        """Return a node's topics and their types."""
        return dict(self._node.get_publisher_names_and_types_by_node(name, namespace))

    def hashes(self, topic: str, no_mangle: bool = False) -> list[tuple[str, str]]:
        """Return type and hash of each publisher of a topic."""
        found = self._node.get_publishers_info_by_topic(topic, no_mangle=no_mangle)
        return [(one.topic_type, str(one.topic_type_hash)) for one in found]


def main() -> None:
    """Do what is asked until the input ends."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever else is printed
    peers = {"": Peer("")}
    while True:
        try:
            who, method, arguments, keywords = pickle.load(requests)
        except EOFError:
            break
        try:
            if method == "close":
                peers.pop(who).close()
                answer: tuple[bool, Any] = (True, None)
            else:
                if who not in peers:
                    peers[who] = Peer(who)
                answer = True, getattr(peers[who], method)(*arguments, **keywords)
        except Exception:  # noqa: BLE001  it is the test's to judge
            answer = False, traceback.format_exc()
        pickle.dump(answer, answers)
        answers.flush()
    for peer in peers.values():
        peer.close()


if __name__ == "__main__":
    main()
