// A ROS 2 publisher or subscriber on Cyclone DDS, announced as rmw_cyclonedds does. The enclave is
// in the participant's user data, and discovery has no type information. The whole
// ros_discovery_info is republished whenever an entity is created or deleted. Command line and
// log: ../peer.hpp.
#include <dds/dds.h>
#include <dds/version.h>

#include "../peer.hpp"
#include "types.h"

namespace {

dds_entity_t checked(dds_entity_t entity, const char* what) {
  if (entity < 0) {
    fprintf(stderr, "%s: %s\n", what, dds_strretcode(-entity));
    exit(1);
  }
  return entity;
}

peer::Guid guid_of(dds_entity_t entity) {
  dds_guid_t guid;
  checked(dds_get_guid(entity, &guid), "cannot read a GUID");
  peer::Guid bytes;
  memcpy(bytes.data(), guid.v, bytes.size());
  return bytes;
}

// Returns idlc's descriptor with the type name that ROS uses on the wire.
dds_topic_descriptor_t named(const dds_topic_descriptor_t& layout, const char* name) {
  dds_topic_descriptor_t descriptor = layout;
  descriptor.m_typename = name;
  return descriptor;
}

void on_cloud(dds_entity_t reader, void* argument);

struct Receiver {
  const peer::Options& options;
  peer::Log& log;
  uint64_t received = 0;
};

// One participant with its nodes, which keeps ros_discovery_info up to date.
class Context {
 public:
  explicit Context(const peer::Options& options)
      : options_(options),
        cloud_(named(layout_PointCloud2_desc, peer::kPointCloudType)),
        info_(named(options.gid_size == 24 ? layout_gid24_Participant_desc
                                           : layout_gid16_Participant_desc,
                    peer::kDiscoveryType)) {
    dds_qos_t* qos = dds_create_qos();
    dds_qset_userdata(qos, "enclave=/;", 10);
    participant_ = checked(dds_create_participant(options.domain, qos, nullptr),
                           "cannot create a participant");
    dds_delete_qos(qos);

    dds_entity_t topic = create_topic(info_, peer::kDiscoveryTopic);
    dds_qos_t* writer_qos = qos_of(false, true, 1);
    info_writer_ = checked(dds_create_writer(participant_, topic, writer_qos, nullptr),
                           "cannot create ros_discovery_info");
    dds_delete_qos(writer_qos);
    dds_qos_t* reader_qos = qos_of(false, true, 1);
    dds_qset_history(reader_qos, DDS_HISTORY_KEEP_ALL, 0);
    checked(dds_create_reader(participant_, topic, reader_qos, nullptr),
            "cannot create ros_discovery_info");
    dds_delete_qos(reader_qos);
  }

  size_t add_node(const std::string& full_name) {
    nodes_.push_back(peer::Node::of(full_name));
    announce();
    return nodes_.size() - 1;
  }

  dds_entity_t add_writer(size_t node, const std::string& ros_topic) {
    dds_qos_t* qos = qos_of(options_.best_effort, options_.transient_local, options_.depth);
    dds_entity_t topic = create_topic(cloud_, peer::dds_topic(ros_topic).c_str());
    dds_entity_t writer =
        checked(dds_create_writer(participant_, topic, qos, nullptr), "cannot create a writer");
    dds_delete_qos(qos);
    nodes_[node].writers.push_back(guid_of(writer));
    announce();
    return writer;
  }

  dds_entity_t add_reader(size_t node, const std::string& ros_topic, Receiver* receiver) {
    dds_qos_t* qos = qos_of(options_.best_effort, options_.transient_local, options_.depth);
    dds_entity_t topic = create_topic(cloud_, peer::dds_topic(ros_topic).c_str());
    dds_listener_t* listener = dds_create_listener(receiver);
    if (receiver) dds_lset_data_available(listener, on_cloud);
    dds_entity_t reader =
        checked(dds_create_reader(participant_, topic, qos, listener), "cannot create a reader");
    dds_delete_listener(listener);
    dds_delete_qos(qos);
    nodes_[node].readers.push_back(guid_of(reader));
    announce();
    return reader;
  }

  void leave() {
    nodes_.clear();
    announce();
    dds_delete(participant_);
  }

 private:
  dds_qos_t* qos_of(bool best_effort, bool transient_local, int depth) {
    dds_qos_t* qos = dds_create_qos();
    dds_qset_reliability(qos, best_effort ? DDS_RELIABILITY_BEST_EFFORT : DDS_RELIABILITY_RELIABLE,
                         DDS_SECS(1));
    dds_qset_durability(qos, transient_local ? DDS_DURABILITY_TRANSIENT_LOCAL
                                             : DDS_DURABILITY_VOLATILE);
    dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, depth);
    return qos;
  }

  dds_entity_t create_topic(const dds_topic_descriptor_t& type, const char* name) {
    return checked(dds_create_topic(participant_, &type, name, nullptr, nullptr),
                   "cannot create a topic");
  }

  void announce() {
    if (options_.gid_size == 24) {
      write_info<layout_gid24_Participant, layout_gid24_Node, layout_gid24_Gid>();
    } else {
      write_info<layout_gid16_Participant, layout_gid16_Node, layout_gid16_Gid>();
    }
  }

  template <typename Participant, typename Node, typename Gid>
  void write_info() {
    auto gid_of = [](const peer::Guid& guid) {
      Gid gid = {};
      memcpy(gid.data, guid.data(), guid.size());
      return gid;
    };
    std::vector<std::vector<Gid>> gids;
    gids.reserve(2 * nodes_.size());
    std::vector<Node> nodes;
    for (auto& node : nodes_) {
      Node entry = {};
      entry.space = node.namespace_.data();
      entry.name = node.name.data();
      auto fill = [&](auto& sequence, const std::vector<peer::Guid>& guids) {
        gids.emplace_back();
        for (const auto& guid : guids) gids.back().push_back(gid_of(guid));
        sequence._buffer = gids.back().data();
        sequence._length = sequence._maximum = static_cast<uint32_t>(guids.size());
      };
      fill(entry.readers, node.readers);
      fill(entry.writers, node.writers);
      nodes.push_back(entry);
    }
    Participant info = {};
    info.gid = gid_of(guid_of(participant_));
    info.nodes._buffer = nodes.data();
    info.nodes._length = info.nodes._maximum = static_cast<uint32_t>(nodes.size());
    checked(dds_write(info_writer_, &info), "cannot write ros_discovery_info");
  }

  const peer::Options& options_;
  const dds_topic_descriptor_t cloud_;
  const dds_topic_descriptor_t info_;
  dds_entity_t participant_;
  dds_entity_t info_writer_;
  std::vector<peer::Node> nodes_;
};

void on_cloud(dds_entity_t reader, void* argument) {
  Receiver& receiver = *static_cast<Receiver*>(argument);
  void* samples[16] = {};
  dds_sample_info_t infos[16];
  for (int taken; (taken = dds_take(reader, samples, infos, 16, 16)) > 0;) {
    for (int i = 0; i < taken; i++) {
      const auto& cloud = *static_cast<layout_PointCloud2*>(samples[i]);
      if (!infos[i].valid_data || cloud.data._length < 8) continue;
      uint64_t seq;
      memcpy(&seq, cloud.data._buffer, sizeof seq);
      receiver.log.received(seq, cloud.data._length + peer::kPointCloudOverhead,
                            cloud.header.sec * 1000000000LL + cloud.header.nanosec);
      if (++receiver.received == receiver.options.count) peer::stopped = 1;
    }
    dds_return_loan(reader, samples, taken);
  }
}

// Not supported by Cyclone DDS 0.8. The caller's configuration stays active.
void size_receive_buffer([[maybe_unused]] uint32_t bytes) {
#if DDS_VERSION_MAJOR > 0 || DDS_VERSION_MINOR >= 10
  const std::string size = std::to_string(bytes) + "B";
  const std::string configuration =
      "<CycloneDDS><Domain><Internal><SocketReceiveBufferSize min=\"default\" max=\"" + size +
      "\"/></Internal></Domain></CycloneDDS>";
  const char* given = getenv("CYCLONEDDS_URI");
  setenv("CYCLONEDDS_URI", given ? (configuration + "," + given).c_str() : configuration.c_str(), 1);
#endif
}

}  // namespace

int main(int argc, char** argv) {
  const peer::Options options = peer::Options::parse(argc, argv);
  peer::stop_on_signals();
  size_receive_buffer(options.receive_buffer);
  peer::Log log(options, "cyclonedds");
  Receiver receiver{options, log};
  Context context(options);

  dds_entity_t endpoint = 0;
  for (size_t i = 0; i < options.nodes.size(); i++) {
    size_t node = context.add_node(options.nodes[i]);
    const std::string topic = options.topic_of(i);
    dds_entity_t added = options.publishes
                             ? context.add_writer(node, topic)
                             : context.add_reader(node, topic, i == 0 ? &receiver : nullptr);
    log.endpoint(options.publishes ? "pub" : "sub", guid_of(added), topic, options.nodes[i]);
    if (i == 0) endpoint = added;
  }
  peer::say("ready");

  if (options.publishes) {
    peer::wait_for_start(options, [&] {
      dds_publication_matched_status_t status;
      checked(dds_get_publication_matched_status(endpoint, &status), "cannot read the status");
      return static_cast<int>(status.current_count);
    });
    std::vector<uint8_t> data(options.data_size());
    for (size_t place = 0; place < data.size(); place++) data[place] = peer::pattern(place);
    char frame_id[] = "lidar";
    layout_PointCloud2 cloud = {};
    cloud.header.frame_id = frame_id;
    cloud.height = 1;
    cloud.point_step = 1;
    cloud.width = cloud.row_step = static_cast<uint32_t>(data.size());
    cloud.data._buffer = data.data();
    cloud.data._length = cloud.data._maximum = static_cast<uint32_t>(data.size());
    cloud.is_dense = true;
    peer::send_all(options, log, [&](uint64_t seq, int64_t now) {
      cloud.header.sec = static_cast<int32_t>(now / 1000000000);
      cloud.header.nanosec = static_cast<uint32_t>(now % 1000000000);
      memcpy(data.data(), &seq, sizeof seq);
      return dds_write(endpoint, &cloud) == DDS_RETCODE_OK;
    });
  } else {
    bool matched = false;
    while (!peer::stopped) {
      dds_subscription_matched_status_t status;
      checked(dds_get_subscription_matched_status(endpoint, &status), "cannot read the status");
      if (!matched && static_cast<int>(status.current_count) >= options.peers) {
        matched = true;
        peer::say("matched");
      }
      usleep(20000);
    }
    log.event("stop");
    peer::say("done");
  }
  context.leave();
  log.event("exit");
  return 0;
}
