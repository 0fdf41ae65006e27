# SPDX-License-Identifier: Apache-2.0
"""ROS 2 messages and services as IDL, one module a package of ROS: names, order and types of their fields."""
