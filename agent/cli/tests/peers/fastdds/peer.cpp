// A ROS 2 publisher or subscriber on Fast DDS, announced as rmw_fastrtps does. Uses only UDPv4, or
// with an option the default transports, which include shared memory. The enclave is in the
// participant's user data, and ros_discovery_info is republished whenever an entity is created or
// deleted. Command line and log: ../peer.hpp.
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/publisher/qos/DataWriterQos.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/subscriber/qos/DataReaderQos.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/TCPv4TransportDescriptor.h>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include <atomic>
#include <memory>

#include "../peer.hpp"

using namespace eprosima::fastdds::dds;
using eprosima::fastdds::rtps::TCPv4TransportDescriptor;
using eprosima::fastdds::rtps::UDPv4TransportDescriptor;
using eprosima::fastrtps::rtps::IPLocator;
using eprosima::fastrtps::rtps::Locator_t;
using eprosima::fastrtps::rtps::GUID_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

namespace {

using Payload = std::vector<uint8_t>;  // serialized, encapsulation included

// A type whose samples are already serialized.
class SerializedType : public TopicDataType {
 public:
  SerializedType(const char* name, size_t size) {
    setName(name);
    m_typeSize = static_cast<uint32_t>(size);
    m_isGetKeyDefined = false;
  }

  bool serialize(void* sample, SerializedPayload_t* out) override {
    const Payload& bytes = *static_cast<Payload*>(sample);
    if (bytes.size() > out->max_size) return false;
    memcpy(out->data, bytes.data(), bytes.size());
    out->length = static_cast<uint32_t>(bytes.size());
    out->encapsulation = CDR_LE;
    return true;
  }

  bool deserialize(SerializedPayload_t* in, void* sample) override {
    static_cast<Payload*>(sample)->assign(in->data, in->data + in->length);
    return true;
  }

  std::function<uint32_t()> getSerializedSizeProvider(void* sample) override {
    return [sample] { return static_cast<uint32_t>(static_cast<Payload*>(sample)->size()); };
  }

  // Fast DDS shares only histories of bounded types.
  bool is_bounded() const override { return true; }

  void* createData() override { return new Payload; }
  void deleteData(void* sample) override { delete static_cast<Payload*>(sample); }
  bool getKey(void*, eprosima::fastrtps::rtps::InstanceHandle_t*, bool) override { return false; }
};

// Writes CDR little-endian with alignment relative to the end of the encapsulation header.
class Cdr {
 public:
  Cdr() : bytes{0, 1, 0, 0} {}

  void u32(uint32_t value) {
    while (bytes.size() % 4 != 0) bytes.push_back(0);
    for (int shift = 0; shift < 32; shift += 8) bytes.push_back(static_cast<uint8_t>(value >> shift));
  }

  void string(const std::string& text) {
    u32(static_cast<uint32_t>(text.size() + 1));
    bytes.insert(bytes.end(), text.begin(), text.end());
    bytes.push_back(0);
  }

  void gid(const peer::Guid& guid, size_t size) {
    bytes.insert(bytes.end(), guid.begin(), guid.end());
    bytes.insert(bytes.end(), size - guid.size(), 0);
  }

  Payload bytes;
};

Payload point_cloud(size_t data_size) {
  Cdr cdr;
  cdr.u32(0);
  cdr.u32(0);
  cdr.string("lidar");
  cdr.u32(1);
  cdr.u32(static_cast<uint32_t>(data_size));
  cdr.u32(0);
  cdr.bytes.push_back(0);
  cdr.u32(1);
  cdr.u32(static_cast<uint32_t>(data_size));
  cdr.u32(static_cast<uint32_t>(data_size));
  for (size_t place = 0; place < data_size; place++) cdr.bytes.push_back(peer::pattern(place));
  cdr.bytes.push_back(1);
  return cdr.bytes;
}

constexpr size_t kStampOffset = 4;
constexpr size_t kDataOffset = 4 + 48;

peer::Guid guid_of(const GUID_t& guid) {
  peer::Guid bytes;
  memcpy(bytes.data(), guid.guidPrefix.value, 12);
  memcpy(bytes.data() + 12, guid.entityId.value, 4);
  return bytes;
}

class Receiver : public DataReaderListener {
 public:
  Receiver(const peer::Options& options, peer::Log& log) : options_(options), log_(log) {}

  void on_data_available(DataReader* reader) override {
    SampleInfo info;
    while (reader->take_next_sample(&sample_, &info) == ReturnCode_t::RETCODE_OK) {
      if (!info.valid_data || sample_.size() < kDataOffset + 8) continue;
      uint32_t stamp[2];
      uint64_t seq;
      memcpy(stamp, &sample_[kStampOffset], sizeof stamp);
      memcpy(&seq, &sample_[kDataOffset], sizeof seq);
      const auto& number = info.sample_identity.sequence_number();
      log_.received(seq, static_cast<int64_t>(number.to64long()), sample_.size(),
                    stamp[0] * 1000000000LL + stamp[1]);
      if (++received_ == options_.count) peer::stopped = 1;
    }
  }

 private:
  const peer::Options& options_;
  peer::Log& log_;
  Payload sample_;
  uint64_t received_ = 0;
};

// One participant with its nodes, which keeps ros_discovery_info up to date.
class Context {
 public:
  Context(const peer::Options& options) : options_(options) {
    auto factory = DomainParticipantFactory::get_instance();
    DomainParticipantQos qos = PARTICIPANT_QOS_DEFAULT;
    qos.name("/");
    const char enclave[] = "enclave=/;";
    qos.user_data().setValue(std::vector<uint8_t>(enclave, enclave + sizeof enclave));
    if (!options.tcp_listen.empty() || !options.tcp_peer.empty()) {
      only_tcp(qos);
    } else if (!options.default_transport) {
      auto udp = std::make_shared<UDPv4TransportDescriptor>();
      udp->receiveBufferSize = options.receive_buffer;
      qos.transport().use_builtin_transports = false;
      qos.transport().user_transports.push_back(udp);
    }
    participant_ = factory->create_participant(options.domain, qos);
    if (!participant_) peer::fail("cannot create a participant");
    publisher_ = participant_->create_publisher(PUBLISHER_QOS_DEFAULT);
    subscriber_ = participant_->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    cloud_type_ = TypeSupport(new SerializedType(peer::kPointCloudType, options.size));
    cloud_type_.register_type(participant_);

    TypeSupport info_type(new SerializedType(peer::kDiscoveryType, 4096));
    info_type.register_type(participant_);
    Topic* topic = create_topic(peer::kDiscoveryTopic, info_type);
    DataWriterQos writer_qos = DATAWRITER_QOS_DEFAULT;
    writer_qos.durability().kind = TRANSIENT_LOCAL_DURABILITY_QOS;
    writer_qos.history().depth = 1;
    common(writer_qos);
    DataReaderQos reader_qos = DATAREADER_QOS_DEFAULT;
    reader_qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
    reader_qos.durability().kind = TRANSIENT_LOCAL_DURABILITY_QOS;
    reader_qos.history().kind = KEEP_ALL_HISTORY_QOS;
    common(reader_qos);
    info_writer_ = publisher_->create_datawriter(topic, writer_qos);
    info_reader_ = subscriber_->create_datareader(topic, reader_qos, &info_drain_);
    if (!info_writer_ || !info_reader_) peer::fail("cannot create ros_discovery_info");
  }

  size_t add_node(const std::string& full_name) {
    nodes_.push_back(peer::Node::of(full_name));
    announce();
    return nodes_.size() - 1;
  }

  // Returns the writer of the messages. With buffers, the node announces another one.
  DataWriter* add_writer(size_t node, const std::string& ros_topic) {
    DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
    qos.reliability().kind =
        options_.best_effort ? BEST_EFFORT_RELIABILITY_QOS : RELIABLE_RELIABILITY_QOS;
    qos.durability().kind = durability();
    qos.history().depth = options_.depth;
    common(qos, options_.data_sharing);
    if (options_.buffers) accept_buffers(qos);
    if (options_.asynchronous) qos.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;
    DataWriter* writer = nullptr;
    for (const std::string& topic : topics(ros_topic)) {
      DataWriter* added = publisher_->create_datawriter(create_topic(topic, cloud_type_), qos);
      if (!added) peer::fail("cannot create a writer");
      if (!writer) nodes_[node].writers.push_back(guid_of(added->guid()));
      writer = added;
    }
    announce();
    return writer;
  }

  DataReader* add_reader(size_t node, const std::string& ros_topic, DataReaderListener* listener) {
    DataReaderQos qos = DATAREADER_QOS_DEFAULT;
    qos.reliability().kind =
        options_.best_effort ? BEST_EFFORT_RELIABILITY_QOS : RELIABLE_RELIABILITY_QOS;
    qos.durability().kind = durability();
    qos.history().depth = options_.depth;
    common(qos, options_.data_sharing);
    if (options_.buffers) accept_buffers(qos);
    DataReader* reader = nullptr;
    for (const std::string& topic : topics(ros_topic)) {
      DataReader* added =
          subscriber_->create_datareader(create_topic(topic, cloud_type_), qos, listener);
      if (!added) peer::fail("cannot create a reader");
      if (!reader) nodes_[node].readers.push_back(guid_of(added->guid()));
      reader = added;
    }
    announce();
    return reader;
  }

  void leave() {
    nodes_.clear();
    announce();
    participant_->delete_contained_entities();
    DomainParticipantFactory::get_instance()->delete_participant(participant_);
  }

 private:
  // The topics of a ROS topic; the last one has the messages.
  std::vector<std::string> topics(const std::string& ros_topic) const {
    std::vector<std::string> all = {peer::dds_topic(ros_topic)};
    if (options_.buffers) all.push_back(all.front() + "/_buf_cpu");
    return all;
  }

  template <typename Qos>
  static void accept_buffers(Qos& qos) {
    const std::string text = "typehash=RIHS01_" + std::string(64, 'a') + ";bufbe.cpu=;";
    qos.user_data().setValue(std::vector<uint8_t>(text.begin(), text.end()));
  }

  static Locator_t tcp_locator(const std::string& address) {
    const size_t colon = address.find(':');
    if (colon == std::string::npos) peer::fail("a TCP address is IPV4:PORT");
    Locator_t locator;
    locator.kind = LOCATOR_KIND_TCPv4;
    IPLocator::setIPv4(locator, address.substr(0, colon));
    IPLocator::setPhysicalPort(locator, static_cast<uint16_t>(atoi(&address[colon + 1])));
    return locator;
  }

  // As XML profiles configure it: the connecting side listens at no port.
  void only_tcp(DomainParticipantQos& qos) const {
    auto tcp = std::make_shared<TCPv4TransportDescriptor>();
    qos.transport().use_builtin_transports = false;
    auto& builtin = qos.wire_protocol().builtin;
    if (!options_.tcp_listen.empty()) {
      const Locator_t locator = tcp_locator(options_.tcp_listen);
      tcp->add_listener_port(IPLocator::getPhysicalPort(locator));
      builtin.metatrafficUnicastLocatorList.push_back(locator);
      qos.wire_protocol().default_unicast_locator_list.push_back(locator);
    } else {
      builtin.initialPeersList.push_back(tcp_locator(options_.tcp_peer));
    }
    qos.transport().user_transports.push_back(tcp);
  }

  struct Drain : DataReaderListener {
    void on_data_available(DataReader* reader) override {
      Payload sample;
      SampleInfo info;
      while (reader->take_next_sample(&sample, &info) == ReturnCode_t::RETCODE_OK) {
      }
    }
  };

  template <typename Qos>
  void common(Qos& qos, bool data_sharing = false) const {
    if (!data_sharing) qos.data_sharing().off();
    qos.endpoint().history_memory_policy =
        eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
  }

  DurabilityQosPolicyKind durability() const {
    return options_.transient_local ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
  }

  Topic* create_topic(const std::string& name, const TypeSupport& type) {
    Topic* topic = participant_->create_topic(name, type->getName(), TOPIC_QOS_DEFAULT);
    if (!topic) peer::fail("cannot create a topic");
    return topic;
  }

  void announce() {
    Cdr cdr;
    cdr.gid(guid_of(participant_->guid()), options_.gid_size);
    cdr.u32(static_cast<uint32_t>(nodes_.size()));
    for (const auto& node : nodes_) {
      cdr.string(node.namespace_);
      cdr.string(node.name);
      for (const auto* gids : {&node.readers, &node.writers}) {
        cdr.u32(static_cast<uint32_t>(gids->size()));
        for (const auto& gid : *gids) cdr.gid(gid, options_.gid_size);
      }
    }
    info_writer_->write(&cdr.bytes);
  }

  const peer::Options& options_;
  Drain info_drain_;
  DomainParticipant* participant_;
  Publisher* publisher_;
  Subscriber* subscriber_;
  TypeSupport cloud_type_;
  DataWriter* info_writer_;
  DataReader* info_reader_;
  std::vector<peer::Node> nodes_;
};

}  // namespace

int main(int argc, char** argv) {
  const peer::Options options = peer::Options::parse(argc, argv);
  peer::stop_on_signals();
  peer::Log log(options, "fastdds");
  Receiver receiver(options, log);
  Context context(options);

  DataWriter* writer = nullptr;
  DataReader* reader = nullptr;
  for (size_t i = 0; i < options.nodes.size(); i++) {
    size_t node = context.add_node(options.nodes[i]);
    const std::string topic = options.topic_of(i);
    if (options.publishes) {
      DataWriter* added = context.add_writer(node, topic);
      log.endpoint("pub", guid_of(added->guid()), topic, options.nodes[i]);
      if (i == 0) writer = added;
    } else {
      DataReader* added = context.add_reader(node, topic, i == 0 ? &receiver : nullptr);
      log.endpoint("sub", guid_of(added->guid()), topic, options.nodes[i]);
      if (i == 0) reader = added;
    }
  }
  peer::say("ready");

  if (options.publishes) {
    peer::wait_for_start(options, [&] {
      PublicationMatchedStatus status;
      writer->get_publication_matched_status(status);
      return status.current_count;
    });
    Payload cloud = point_cloud(options.data_size());
    peer::send_all(options, log, [&](uint64_t seq, int64_t now) {
      const uint32_t stamp[2] = {static_cast<uint32_t>(now / 1000000000),
                                 static_cast<uint32_t>(now % 1000000000)};
      memcpy(&cloud[kStampOffset], stamp, sizeof stamp);
      memcpy(&cloud[kDataOffset], &seq, sizeof seq);
      return writer->write(&cloud);
    });
  } else {
    bool matched = false;
    while (!peer::stopped) {
      SubscriptionMatchedStatus status;
      reader->get_subscription_matched_status(status);
      if (!matched && status.current_count >= options.peers) {
        matched = true;
        peer::say("matched");
      }
      usleep(20000);
    }
    reader->set_listener(nullptr);
    log.event("stop");
    peer::say("done");
  }
  context.leave();
  log.event("exit");
  return 0;
}
