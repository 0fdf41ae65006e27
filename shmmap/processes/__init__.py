# SPDX-License-Identifier: Apache-2.0
"""Child processes: started and ended without leaving any behind."""
