# SPDX-License-Identifier: Apache-2.0
#
# What find_package(shmmap) finds: the target shmmap::shmmap, headers and the C++ standard that they need.
# They are in ../../../include from here, wherever all of it was moved to.

get_filename_component(_shmmap_prefix "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
if(NOT EXISTS "${_shmmap_prefix}/include/shmmap/shmmap.hpp")
  set(shmmap_FOUND FALSE)
  set(shmmap_NOT_FOUND_MESSAGE "${_shmmap_prefix}/include/shmmap/shmmap.hpp is missing")
  return()
endif()

if(NOT TARGET shmmap::shmmap)
  add_library(shmmap::shmmap INTERFACE IMPORTED GLOBAL)
  set_target_properties(shmmap::shmmap PROPERTIES
    INTERFACE_INCLUDE_DIRECTORIES "${_shmmap_prefix}/include"
    INTERFACE_COMPILE_FEATURES cxx_std_17)
endif()

# ament_target_dependencies() and ament_auto_add_executable() go by these
set(shmmap_TARGETS shmmap::shmmap)
set(shmmap_INCLUDE_DIRS "${_shmmap_prefix}/include")
unset(_shmmap_prefix)
