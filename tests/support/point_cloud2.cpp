// SPDX-License-Identifier: Apache-2.0
// Prints a layer's cells as messages: point_cloud2 LAYER.  One line a field, then the data in hexadecimal.

#include <cstdio>
#include <shmmap/shmmap.hpp>

#include "autoware_messages.hpp"

int main(int count, char** words) {
  if (count != 2) return 2;
  try {
    shmmap::Client client;
    plain::Cloud message;
    message.fields.resize(7);  // of an earlier cell
    for (const auto& cell : client.area(shmmap::Circle{0.0, 0.0, 1e6}, {words[1]}, 60.0).cells) {
      shmmap::to_point_cloud2(*cell, message);
      std::printf("cell %s %u %u %u\n", message.header.frame_id.c_str(), message.width, message.height, message.point_step);
      for (const auto& field : message.fields)
        std::printf("field %s %u %u %u\n", field.name.c_str(), field.offset, static_cast<unsigned>(field.datatype),
                    field.count);
      for (const auto byte : message.data) std::printf("%02x", static_cast<unsigned>(byte));
      std::printf("\n");
    }
    if (client.map_version() == 0) return 3;
  } catch (const shmmap::Error& error) {
    std::printf("%s\n", error.code().c_str());
  }
}
