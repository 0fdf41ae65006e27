# SPDX-License-Identifier: Apache-2.0
#
# Which versions find_package(shmmap VERSION) takes this one for: older ones of the same major number, and while
# that is 0, of the same minor number (https://semver.org/).

set(PACKAGE_VERSION 0.4.0)

string(REGEX MATCH "^(0\\.[0-9]+|[0-9]+)" _shmmap_series "${PACKAGE_VERSION}")
if("${PACKAGE_FIND_VERSION}" VERSION_LESS_EQUAL "${PACKAGE_VERSION}"
   AND "${PACKAGE_FIND_VERSION}" VERSION_GREATER_EQUAL "${_shmmap_series}")
  set(PACKAGE_VERSION_COMPATIBLE TRUE)
endif()
if("${PACKAGE_FIND_VERSION}" VERSION_EQUAL "${PACKAGE_VERSION}")
  set(PACKAGE_VERSION_EXACT TRUE)
endif()
unset(_shmmap_series)
