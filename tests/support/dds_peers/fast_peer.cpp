// SPDX-License-Identifier: Apache-2.0
// A client over Fast DDS in rmw_cyclonedds_cpp's mapping; messages are written and read by hand.
//
//   fast_peer DOMAIN VERB NAME ...      as cyclone_peer.c, and prints the same
//
// A fourth verb, `incompatible`, speaks rmw_fastrtps_cpp's mapping: no clientid, no 16 bytes. It prints "matched" when
// the service is there, and waits until its standard input ends. A fifth, `raw`, sends differential requests as
// they are given, each the hexadecimal digits of a sample with its encapsulation, until they are acknowledged.
#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>
#include <string>
#include <thread>
#include <vector>

using namespace eprosima::fastdds::dds;
using Bytes = std::vector<uint8_t>;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

[[noreturn]] static void fail(const char *what) {
  std::fprintf(stderr, "fast_peer: %s\n", what);
  std::exit(1);
}

// A type whose samples are bytes, encapsulation included.
class BytesType : public TopicDataType {
 public:
  explicit BytesType(const std::string &name) {
    setName(name.c_str());
    m_typeSize = 64 << 20;
    m_isGetKeyDefined = false;
    auto_fill_type_object(false);
    auto_fill_type_information(false);
  }
  bool serialize(void *data, SerializedPayload_t *payload) override {
    const Bytes &bytes = *static_cast<Bytes *>(data);
    std::memcpy(payload->data, bytes.data(), bytes.size());
    payload->length = static_cast<uint32_t>(bytes.size());
    payload->encapsulation = CDR_LE;
    return true;
  }
  bool deserialize(SerializedPayload_t *payload, void *data) override {
    static_cast<Bytes *>(data)->assign(payload->data, payload->data + payload->length);
    return true;
  }
  std::function<uint32_t()> getSerializedSizeProvider(void *data) override {
    return [data] { return static_cast<uint32_t>(static_cast<Bytes *>(data)->size()); };
  }
  void *createData() override { return new Bytes; }
  void deleteData(void *data) override { delete static_cast<Bytes *>(data); }
  bool getKey(void *, InstanceHandle_t *, bool) override { return false; }
};

class Writer {
 public:
  Bytes bytes{0, 1, 0, 0};
  template <class T>
  void number(T value) {
    while ((bytes.size() - 4) % sizeof(T)) bytes.push_back(0);
    uint8_t raw[sizeof(T)];
    std::memcpy(raw, &value, sizeof(T));
    bytes.insert(bytes.end(), raw, raw + sizeof(T));
  }
  void text(const char *value) {
    number<uint32_t>(static_cast<uint32_t>(std::strlen(value) + 1));
    bytes.insert(bytes.end(), value, value + std::strlen(value) + 1);
  }
  void texts(char **begin, char **end) {
    number<uint32_t>(static_cast<uint32_t>(end - begin));
    for (; begin != end; begin++) text(*begin);
  }
};

class Reader {
 public:
  explicit Reader(const Bytes &bytes) : bytes_(bytes) {}
  template <class T>
  T number() {
    while ((at_ - 4) % sizeof(T)) at_++;
    T value;
    need(sizeof(T));
    std::memcpy(&value, bytes_.data() + at_, sizeof(T));
    at_ += sizeof(T);
    return value;
  }
  std::string text() {
    const auto size = number<uint32_t>();
    need(size);
    if (!size || bytes_[at_ + size - 1]) fail("a text without end");
    std::string value(reinterpret_cast<const char *>(bytes_.data()) + at_, size - 1);
    at_ += size;
    return value;
  }
  Bytes octets() {
    const auto size = number<uint32_t>();
    need(size);
    Bytes value(bytes_.begin() + static_cast<long>(at_), bytes_.begin() + static_cast<long>(at_ + size));
    at_ += size;
    return value;
  }
  void end() const {
    if (bytes_.size() - at_ > 3) fail("more bytes than a message");
  }

 private:
  void need(size_t count) const {
    if (at_ + count > bytes_.size()) fail("fewer bytes than a message");
  }
  const Bytes &bytes_;
  size_t at_ = 4;
};

static void print_header(const char *what, Reader &from) {
  const auto sec = from.number<int32_t>();
  const auto nanosec = from.number<uint32_t>();
  std::printf("%s %d %u %s\n", what, sec, nanosec, from.text().c_str());
}

static void print_cells(Reader &from) {
  for (auto left = from.number<uint32_t>(); left; left--) {
    const std::string id = from.text();
    std::string cloud, data = "data ";
    char line[256];
    const auto sec = from.number<int32_t>();
    const auto nanosec = from.number<uint32_t>();
    const std::string frame = from.text();
    const auto height = from.number<uint32_t>(), width = from.number<uint32_t>();
    std::vector<std::string> fields;
    for (auto count = from.number<uint32_t>(); count; count--) {
      const std::string name = from.text();
      const auto offset = from.number<uint32_t>();
      const auto datatype = from.number<uint8_t>();
      const auto values = from.number<uint32_t>();
      std::snprintf(line, sizeof line, "field %u %u %u %s", offset, datatype, values, name.c_str());
      fields.emplace_back(line);
    }
    const auto bigendian = from.number<uint8_t>();
    const auto point_step = from.number<uint32_t>(), row_step = from.number<uint32_t>();
    const char *digits = "0123456789abcdef";
    for (const uint8_t byte : from.octets()) (data += digits[byte >> 4]) += digits[byte & 15];
    const auto dense = from.number<uint8_t>();
    float box[4];
    for (float &one : box) one = from.number<float>();
    std::printf("cell %a %a %a %a %s\n", box[0], box[1], box[2], box[3], id.c_str());
    std::printf("cloud %d %u %s\n", sec, nanosec, frame.c_str());
    std::printf("shape %u %u %d %u %u %d\n", height, width, bigendian, point_step, row_step, dense);
    for (const std::string &field : fields) std::puts(field.c_str());
    std::puts(data.c_str());
  }
}

int main(int argc, char **argv) {
  if (argc < 4) fail("usage");
  const int domain = std::atoi(argv[1]);
  const std::string verb = argv[2], name = argv[3];
  const bool incompatible = verb == "incompatible";
  DomainParticipantQos qos;
  auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  udp->interfaceWhiteList.push_back("127.0.0.1");
  udp->receiveBufferSize = 4 << 20;
  qos.transport().use_builtin_transports = false;
  qos.transport().user_transports.push_back(udp);
  for (uint32_t n = 0; n < 20; n++) {
    eprosima::fastrtps::rtps::Locator_t peer;
    eprosima::fastrtps::rtps::IPLocator::setIPv4(peer, 127, 0, 0, 1);
    peer.port = static_cast<uint32_t>(7400 + 250 * domain + 10) + 2 * n;
    qos.wire_protocol().builtin.initialPeersList.push_back(peer);
  }
  qos.wire_protocol().builtin.discovery_config.leaseDuration_announcementperiod = {0, 100000000};
  auto *factory = DomainParticipantFactory::get_instance();
  auto *participant = factory->create_participant(static_cast<uint32_t>(domain), qos);
  if (!participant) fail("join");
  const std::string what = verb == "differential" || verb == "raw" ? "Differential" : verb == "selected" ? "Selected" : "Partial";
  const std::string type = "autoware_map_msgs::srv::dds_::Get" + what + "PointCloudMap_";
  TypeSupport request_type(new BytesType(type + "Request_")), reply_type(new BytesType(type + "Response_"));
  request_type.register_type(participant);
  reply_type.register_type(participant);
  auto *requests = participant->create_topic("rq" + name + "Request", type + "Request_", TOPIC_QOS_DEFAULT);
  auto *replies = participant->create_topic("rr" + name + "Reply", type + "Response_", TOPIC_QOS_DEFAULT);
  const std::string user = incompatible ? "" : "clientid=1.f." + std::to_string(getpid()) + ";";
  const std::vector<eprosima::fastrtps::rtps::octet> user_data(user.begin(), user.end());
  DataWriterQos writer_qos;
  writer_qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
  writer_qos.history().depth = 10;
  writer_qos.user_data().data_vec(user_data);
  writer_qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::DYNAMIC_RESERVE_MEMORY_MODE;
  writer_qos.reliable_writer_qos().times.heartbeatPeriod = {0, 50000000};
  DataReaderQos reader_qos;
  reader_qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
  reader_qos.history().depth = 10;
  reader_qos.user_data().data_vec(user_data);
  reader_qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::DYNAMIC_RESERVE_MEMORY_MODE;
  auto *writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(requests, writer_qos);
  auto *reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(replies, reader_qos);
  if (!writer || !reader) fail("endpoints");
  for (int n = 0;; n++) {
    PublicationMatchedStatus readers;
    SubscriptionMatchedStatus writers;
    writer->get_publication_matched_status(readers);
    reader->get_subscription_matched_status(writers);
    if (readers.current_count > 0 && writers.current_count > 0) break;
    if (n == 10000) fail("the service is not there");
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
  if (verb == "raw") {
    for (int n = 4; n < argc; n++) {
      Bytes sample;
      for (const char *at = argv[n]; at[0] && at[1]; at += 2)
        sample.push_back(static_cast<uint8_t>(std::stoi(std::string(at, 2), nullptr, 16)));
      if (!writer->write(&sample)) fail("write");
      if (writer->wait_for_acknowledgments({10, 0}) != ReturnCode_t::RETCODE_OK) fail("not acknowledged");
    }
    std::puts("end");
  }
  Writer request;
  const uint64_t guid = 0xfa57dd5000000000u | static_cast<uint32_t>(getpid());
  const int64_t seq = 78;
  if (!incompatible) {
    request.number<uint64_t>(guid);
    request.number<int64_t>(seq);
  }
  if (verb == "raw") {
  } else if (incompatible) {
    for (int n = 0; n < 3; n++) request.number<float>(0);
  } else if (verb == "selected") {
    request.texts(argv + 4, argv + argc);
  } else {
    if (argc < 7) fail("usage");
    for (int n = 4; n < 7; n++) request.number<float>(std::strtof(argv[n], nullptr));
    if (verb == "differential") request.texts(argv + 7, argv + argc);
  }
  if (verb != "raw" && !writer->write(&request.bytes)) fail("write");
  if (incompatible) {
    std::puts("matched");
    std::fflush(stdout);
    while (std::getchar() != EOF) {
    }
  }
  // A request that is written before the service has found this writer is lost: CycloneDDS skips what is older than
  // the first heartbeat, and the writer does not learn of it. So it is asked again, under the same number.
  int asked_again = 0;
  for (bool done = incompatible || verb == "raw"; !done;) {
    if (!reader->wait_for_unread_message({2, 0})) {
      if (++asked_again == 30) fail("no reply");
      if (!writer->write(&request.bytes)) fail("write");
      continue;
    }
    Bytes bytes;
    SampleInfo info;
    if (reader->take_next_sample(&bytes, &info) != ReturnCode_t::RETCODE_OK || !info.valid_data) continue;
    if (bytes.empty()) continue;  // Fast DDS 2.9.1 hands out one now and then when others ask at the same time
    Reader from(bytes);
    if (from.number<uint64_t>() != guid || from.number<int64_t>() != seq) continue;
    print_header("header", from);
    print_cells(from);
    if (verb == "differential")
      for (auto left = from.number<uint32_t>(); left; left--) std::printf("remove %s\n", from.text().c_str());
    from.end();
    std::puts("end");
    done = true;
  }
  participant->delete_contained_entities();
  factory->delete_participant(participant);
  return 0;
}
