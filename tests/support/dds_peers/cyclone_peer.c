/* SPDX-License-Identifier: Apache-2.0
 * A ROS client over CycloneDDS' own C library, as rmw_cyclonedds_cpp is one.
 *
 *   cyclone_peer DOMAIN partial NAME X Y RADIUS
 *   cyclone_peer DOMAIN differential NAME X Y RADIUS [ID ...]
 *   cyclone_peer DOMAIN selected NAME [ID ...]
 *
 * Prints the reply, one thing a line; numbers with fractions as %a.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "autoware.h"
#include "dds/dds.h"

typedef autoware_map_msgs_msg_dds__CellWithID_ Cell;

static void fail(const char *what) {
  fprintf(stderr, "cyclone_peer: %s\n", what);
  exit(1);
}

static dds_entity_t ok(dds_entity_t entity, const char *what) {
  if (entity < 0) fail(what);
  return entity;
}

static void print_header(const char *what, const std_msgs_msg_dds__Header_ *header) {
  printf("%s %d %u %s\n", what, header->stamp.sec, header->stamp.nanosec, header->frame_id);
}

static void print_cells(const Cell *cells, uint32_t count) {
  for (uint32_t i = 0; i < count; i++) {
    const sensor_msgs_msg_dds__PointCloud2_ *cloud = &cells[i].pointcloud;
    printf("cell %a %a %a %a %s\n", cells[i].metadata.min_x, cells[i].metadata.min_y, cells[i].metadata.max_x,
           cells[i].metadata.max_y, cells[i].cell_id);
    print_header("cloud", &cloud->header);
    printf("shape %u %u %d %u %u %d\n", cloud->height, cloud->width, cloud->is_bigendian, cloud->point_step,
           cloud->row_step, cloud->is_dense);
    for (uint32_t n = 0; n < cloud->fields._length; n++) {
      const sensor_msgs_msg_dds__PointField_ *field = &cloud->fields._buffer[n];
      printf("field %u %u %u %s\n", field->offset, field->datatype, field->count, field->name);
    }
    printf("data ");
    for (uint32_t n = 0; n < cloud->data._length; n++) printf("%02x", cloud->data._buffer[n]);
    printf("\n");
  }
}

static dds_sequence_string ids(int count, char **words) {
  dds_sequence_string made = {._maximum = (uint32_t)count, ._length = (uint32_t)count, ._buffer = words};
  return made;
}

int main(int argc, char **argv) {
  if (argc < 4) fail("usage");
  const dds_entity_t participant = ok(dds_create_participant((dds_domainid_t)atoi(argv[1]), NULL, NULL), "join");
  const char *verb = argv[2];
  const int differential = strcmp(verb, "differential") == 0, selected = strcmp(verb, "selected") == 0;
  const dds_topic_descriptor_t *request_type =
      differential ? &autoware_map_msgs_srv_dds__GetDifferentialPointCloudMap_Request__desc
      : selected   ? &autoware_map_msgs_srv_dds__GetSelectedPointCloudMap_Request__desc
                   : &autoware_map_msgs_srv_dds__GetPartialPointCloudMap_Request__desc;
  const dds_topic_descriptor_t *reply_type =
      differential ? &autoware_map_msgs_srv_dds__GetDifferentialPointCloudMap_Response__desc
      : selected   ? &autoware_map_msgs_srv_dds__GetSelectedPointCloudMap_Response__desc
                   : &autoware_map_msgs_srv_dds__GetPartialPointCloudMap_Response__desc;
  char name[512];
  dds_qos_t *qos = dds_create_qos();
  dds_qset_reliability(qos, DDS_RELIABILITY_RELIABLE, DDS_INFINITY);
  dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, 10);
  snprintf(name, sizeof name, "clientid= 1.10.%x.0.0.1;", (unsigned)getpid());
  dds_qset_userdata(qos, name, strlen(name));
  snprintf(name, sizeof name, "rq%sRequest", argv[3]);
  const dds_entity_t requests = ok(dds_create_topic(participant, request_type, name, NULL, NULL), "topic");
  snprintf(name, sizeof name, "rr%sReply", argv[3]);
  const dds_entity_t replies = ok(dds_create_topic(participant, reply_type, name, NULL, NULL), "topic");
  const dds_entity_t writer = ok(dds_create_writer(participant, requests, qos, NULL), "writer");
  const dds_entity_t reader = ok(dds_create_reader(participant, replies, qos, NULL), "reader");
  for (int n = 0;; n++) { /* as rmw_service_server_is_available */
    if (dds_get_matched_subscriptions(writer, NULL, 0) > 0 && dds_get_matched_publications(reader, NULL, 0) > 0) break;
    if (n == 10000) fail("the service is not there");
    dds_sleepfor(DDS_MSECS(2));
  }
  dds_instance_handle_t guid;
  if (dds_get_instance_handle(writer, &guid) < 0) fail("handle");
  const int64_t seq = 77;
  autoware_map_msgs_msg_dds__AreaInfo_ area = {0, 0, 0};
  if (!selected) {
    if (argc < 7) fail("usage");
    area.center_x = strtof(argv[4], NULL);
    area.center_y = strtof(argv[5], NULL);
    area.radius = strtof(argv[6], NULL);
  }
  dds_return_t written;
  if (differential) {
    autoware_map_msgs_srv_dds__GetDifferentialPointCloudMap_Request_ request = {guid, seq, area, ids(argc - 7, argv + 7)};
    written = dds_write(writer, &request);
  } else if (selected) {
    autoware_map_msgs_srv_dds__GetSelectedPointCloudMap_Request_ request = {guid, seq, ids(argc - 4, argv + 4)};
    written = dds_write(writer, &request);
  } else {
    autoware_map_msgs_srv_dds__GetPartialPointCloudMap_Request_ request = {guid, seq, area};
    written = dds_write(writer, &request);
  }
  if (written < 0) fail("write");
  const dds_entity_t waitset = dds_create_waitset(participant);
  dds_waitset_attach(waitset, dds_create_readcondition(reader, DDS_ANY_STATE), 0);
  for (;;) {
    void *sample = NULL;
    dds_sample_info_t info;
    if (dds_waitset_wait(waitset, NULL, 0, DDS_SECS(60)) <= 0) fail("no reply");
    if (dds_take(reader, &sample, &info, 1, 1) <= 0 || !info.valid_data) continue;
    const autoware_map_msgs_srv_dds__GetDifferentialPointCloudMap_Response_ *reply = sample;
    if (reply->guid == guid && reply->seq == seq) { /* the three replies begin alike */
      print_header("header", &reply->header);
      print_cells(reply->cells._buffer, reply->cells._length);
      if (differential)
        for (uint32_t n = 0; n < reply->ids_to_remove._length; n++) printf("remove %s\n", reply->ids_to_remove._buffer[n]);
      printf("end\n");
      break;
    }
    dds_return_loan(reader, &sample, 1);
  }
  dds_delete_qos(qos);
  dds_delete(participant); /* a participant that just vanishes is waited for by others */
  return 0;
}
