// The peer on Cyclone DDS. Command line and log: README.md.
#include <dds/dds.h>

#include "shapes.h"
#include "shapes.hpp"

namespace {

dds_entity_t checked(dds_return_t result, const char* failure) {
  if (result < 0) peer::fail(failure);
  return result;
}

dds_duration_t milliseconds(int64_t number) { return DDS_MSECS(number); }

class Cyclone : public shapes::Peer {
 public:
  explicit Cyclone(const shapes::Options& options)
      : publishes_(options.publishes), color_(options.color), payload_(options.payload()) {
    participant_ =
        checked(dds_create_participant(options.domain, nullptr, nullptr), "no participant");
    const dds_entity_t topic = checked(
        dds_create_topic(participant_, &ShapeType_desc, options.topic.c_str(), nullptr, nullptr),
        "no topic");
    dds_qos_t* qos = qos_of(options);
    if (publishes_) {
      const dds_entity_t group =
          checked(dds_create_publisher(participant_, qos, nullptr), "no publisher");
      endpoint_ = checked(dds_create_writer(group, topic, qos, nullptr), "no writer");
    } else {
      const dds_entity_t group =
          checked(dds_create_subscriber(participant_, qos, nullptr), "no subscriber");
      endpoint_ = checked(dds_create_reader(group, topic, qos, nullptr), "no reader");
    }
    dds_delete_qos(qos);
    shape_.color = color_.data();
    shape_.shapesize = shapes::kShapeSize;
    shape_.additional_payload._buffer = payload_.data();
    shape_.additional_payload._length = static_cast<uint32_t>(payload_.size());
    shape_.additional_payload._maximum = static_cast<uint32_t>(payload_.size());
  }

  ~Cyclone() override { dds_delete(participant_); }

  peer::Guid guid() override {
    dds_guid_t guid;
    checked(dds_get_guid(endpoint_, &guid), "no GUID");
    peer::Guid bytes;
    memcpy(bytes.data(), guid.v, bytes.size());
    return bytes;
  }

  void write(int32_t number) override {
    shape_.x = number;
    checked(dds_write(endpoint_, &shape_), "cannot write");
  }

  shapes::Events poll() override {
    shapes::Events events;
    if (publishes_) {
      dds_publication_matched_status_t matched;
      dds_offered_incompatible_qos_status_t incompatible;
      dds_get_publication_matched_status(endpoint_, &matched);
      dds_get_offered_incompatible_qos_status(endpoint_, &incompatible);
      note(events, matched.current_count, incompatible);
    } else {
      dds_subscription_matched_status_t matched;
      dds_requested_incompatible_qos_status_t incompatible;
      dds_get_subscription_matched_status(endpoint_, &matched);
      dds_get_requested_incompatible_qos_status(endpoint_, &incompatible);
      note(events, matched.current_count, incompatible);
      take(events);
    }
    return events;
  }

 private:
  static dds_qos_t* qos_of(const shapes::Options& options) {
    dds_qos_t* qos = dds_create_qos();
    dds_qset_reliability(
        qos, options.best_effort ? DDS_RELIABILITY_BEST_EFFORT : DDS_RELIABILITY_RELIABLE,
        DDS_SECS(1));
    dds_qset_durability(qos, options.transient_local ? DDS_DURABILITY_TRANSIENT_LOCAL
                                                     : DDS_DURABILITY_VOLATILE);
    const auto history = options.keep_all ? DDS_HISTORY_KEEP_ALL : DDS_HISTORY_KEEP_LAST;
    dds_qset_history(qos, history, options.depth);
    // What a writer keeps for late readers.
    dds_qset_durability_service(qos, 0, history, options.depth, DDS_LENGTH_UNLIMITED,
                                DDS_LENGTH_UNLIMITED, DDS_LENGTH_UNLIMITED);
    if (options.exclusive) dds_qset_ownership(qos, DDS_OWNERSHIP_EXCLUSIVE);
    if (options.publishes && options.exclusive) dds_qset_ownership_strength(qos, options.strength);
    if (options.deadline >= 0) dds_qset_deadline(qos, milliseconds(options.deadline));
    if (options.publishes && options.lifespan >= 0)
      dds_qset_lifespan(qos, milliseconds(options.lifespan));
    if (options.lease >= 0)
      dds_qset_liveliness(qos, DDS_LIVELINESS_AUTOMATIC, milliseconds(options.lease));
    std::vector<const char*> partitions;
    for (const auto& name : options.partitions) partitions.push_back(name.c_str());
    if (!partitions.empty())
      dds_qset_partition(qos, static_cast<uint32_t>(partitions.size()), partitions.data());
    return qos;
  }

  template <typename Status>
  static void note(shapes::Events& events, uint32_t matched, const Status& incompatible) {
    events.matched = static_cast<int>(matched);
    if (incompatible.total_count_change > 0)
      events.incompatible.push_back(incompatible.last_policy_id);
  }

  void take(shapes::Events& events) {
    void* samples[16] = {};
    dds_sample_info_t infos[16];
    for (int taken; (taken = dds_take(endpoint_, samples, infos, 16, 16)) > 0;) {
      for (int i = 0; i < taken; i++) {
        const auto& shape = *static_cast<ShapeType*>(samples[i]);
        if (infos[i].valid_data)
          events.samples.push_back({shape.x, shape.color, shape.additional_payload._length});
      }
      dds_return_loan(endpoint_, samples, taken);
    }
  }

  const bool publishes_;
  std::string color_;
  std::vector<uint8_t> payload_;
  dds_entity_t participant_, endpoint_;
  ShapeType shape_ = {};
};

}  // namespace

int main(int argc, char** argv) {
  // Filters of this library are functions of the program, which the wire does not show.
  const auto options = shapes::Options::parse(argc, argv, {"filter"});
  peer::stop_on_signals();
  Cyclone cyclone(options);
  shapes::Course(options, "cyclonedds", cyclone).run();
  return 0;
}
