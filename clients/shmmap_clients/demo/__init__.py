# SPDX-License-Identifier: Apache-2.0
"""What demonstrations and checks need of the programs: a picture, a scene."""
