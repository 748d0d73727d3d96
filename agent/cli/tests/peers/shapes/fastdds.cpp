// The peer on Fast DDS, over UDP only. Command line and log: README.md.
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/publisher/qos/DataWriterQos.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/subscriber/qos/DataReaderQos.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastcdr/Cdr.h>
#include <fastrtps/config.h>
#include <fastrtps/utils/md5.h>

#include "shapes.hpp"

// Content filters came with 2.6.
#if FASTRTPS_VERSION_MAJOR > 2 || FASTRTPS_VERSION_MINOR >= 6
#define HAS_FILTERS
#include <fastdds/dds/topic/ContentFilteredTopic.hpp>
#include <fastrtps/types/DynamicTypeBuilder.h>
#include <fastrtps/types/DynamicTypeBuilderPtr.h>
#include <fastrtps/types/DynamicTypeBuilderFactory.h>
#endif

using namespace eprosima::fastdds::dds;
using eprosima::fastcdr::Cdr;
using eprosima::fastdds::rtps::UDPv4TransportDescriptor;
using eprosima::fastrtps::Duration_t;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

namespace {

struct Shape {
  std::string color;
  int32_t x = 0, y = 0, shapesize = shapes::kShapeSize;
  std::vector<uint8_t> additional_payload;
};

class ShapeSupport : public TopicDataType {
 public:
  explicit ShapeSupport(size_t payload) {
    setName(shapes::kType);
    m_typeSize = static_cast<uint32_t>(payload + 1024);
    m_isGetKeyDefined = true;
    auto_fill_type_object(false);
    auto_fill_type_information(false);
  }

  bool serialize(void* sample, SerializedPayload_t* out) override {
    const Shape& shape = *static_cast<Shape*>(sample);
    eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(out->data), out->max_size);
    Cdr cdr(buffer, Cdr::LITTLE_ENDIANNESS, Cdr::DDS_CDR);
    cdr.serialize_encapsulation();
    cdr << shape.color << shape.x << shape.y << shape.shapesize << shape.additional_payload;
    out->encapsulation = CDR_LE;
    out->length = static_cast<uint32_t>(cdr.getSerializedDataLength());
    return true;
  }

  bool deserialize(SerializedPayload_t* in, void* sample) override {
    Shape& shape = *static_cast<Shape*>(sample);
    eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(in->data), in->length);
    Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
    try {
      cdr.read_encapsulation();
      cdr >> shape.color >> shape.x >> shape.y >> shape.shapesize >> shape.additional_payload;
    } catch (const eprosima::fastcdr::exception::Exception&) {
      return false;
    }
    return true;
  }

  std::function<uint32_t()> getSerializedSizeProvider(void* sample) override {
    const Shape& shape = *static_cast<Shape*>(sample);
    const size_t size = shape.color.size() + shape.additional_payload.size() + 64;
    return [size] { return static_cast<uint32_t>(size); };
  }

  // The hash of the key, which is the big-endian serialized color: its size is unbounded.
  bool getKey(void* sample, InstanceHandle_t* handle, bool) override {
    const std::string& color = static_cast<Shape*>(sample)->color;
    const auto length = static_cast<uint32_t>(color.size() + 1);
    std::string key;
    for (int shift = 24; shift >= 0; shift -= 8) key.push_back(static_cast<char>(length >> shift));
    key.append(color.c_str(), length);
    MD5 hash;
    hash.init();
    hash.update(key.data(), static_cast<unsigned>(key.size()));
    hash.finalize();
    memcpy(handle->value, hash.digest, sizeof hash.digest);
    return true;
  }

  void* createData() override { return new Shape; }
  void deleteData(void* sample) override { delete static_cast<Shape*>(sample); }
};

#ifdef HAS_FILTERS
// Registers the members of the type, among which a filter looks up its fields. A writer then
// applies the filters of readers of this library.
void describe_type() {
  using namespace eprosima::fastrtps::types;
  auto& types = *DynamicTypeBuilderFactory::get_instance();
  DynamicTypeBuilder_ptr shape(types.create_struct_builder());
  shape->set_name(shapes::kType);
  shape->add_member(0, "color", types.create_string_type());
  shape->apply_annotation_to_member(0, ANNOTATION_KEY_ID, "value", "true");
  shape->add_member(1, "x", types.create_int32_type());
  shape->add_member(2, "y", types.create_int32_type());
  shape->add_member(3, "shapesize", types.create_int32_type());
  DynamicTypeBuilder_ptr bytes(
      types.create_sequence_builder(types.create_byte_type(), BOUND_UNLIMITED));
  shape->add_member(4, "additional_payload", bytes->build());
  const DynamicType_ptr type = shape->build();
  for (bool complete : {true, false}) {
    TypeObject object;
    types.build_type_object(type, object, complete);
  }
}
#endif

Duration_t milliseconds(int64_t number) {
  return {static_cast<int32_t>(number / 1000), static_cast<uint32_t>(number % 1000 * 1000000)};
}

template <typename Entity>
Entity* checked(Entity* entity, const char* failure) {
  if (!entity) peer::fail(failure);
  return entity;
}

class FastDds : public shapes::Peer {
 public:
  explicit FastDds(const shapes::Options& options) {
    DomainParticipantQos qos = PARTICIPANT_QOS_DEFAULT;
    qos.name("shapes");
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(std::make_shared<UDPv4TransportDescriptor>());
    participant_ = checked(
        DomainParticipantFactory::get_instance()->create_participant(options.domain, qos),
        "no participant");
    TypeSupport type(new ShapeSupport(options.size));
    type.register_type(participant_);
    Topic* topic = checked(
        participant_->create_topic(options.topic, type->getName(), TOPIC_QOS_DEFAULT), "no topic");
    if (options.publishes) {
      add_writer(options, topic);
    } else {
      add_reader(options, topic);
    }
    shape_.color = options.color;
    shape_.additional_payload = options.payload();
  }

  ~FastDds() override {
    participant_->delete_contained_entities();
    DomainParticipantFactory::get_instance()->delete_participant(participant_);
  }

  peer::Guid guid() override {
    const auto& guid = writer_ ? writer_->guid() : reader_->guid();
    peer::Guid bytes;
    memcpy(bytes.data(), guid.guidPrefix.value, 12);
    memcpy(bytes.data() + 12, guid.entityId.value, 4);
    return bytes;
  }

  void write(int32_t number) override {
    shape_.x = number;
    if (!writer_->write(&shape_)) peer::fail("cannot write");
  }

  shapes::Events poll() override {
    shapes::Events events;
    if (writer_) {
      PublicationMatchedStatus matched;
      OfferedIncompatibleQosStatus incompatible;
      writer_->get_publication_matched_status(matched);
      writer_->get_offered_incompatible_qos_status(incompatible);
      note(events, matched.current_count, incompatible);
    } else {
      SubscriptionMatchedStatus matched;
      RequestedIncompatibleQosStatus incompatible;
      reader_->get_subscription_matched_status(matched);
      reader_->get_requested_incompatible_qos_status(incompatible);
      note(events, matched.current_count, incompatible);
      Shape shape;
      SampleInfo info;
      while (reader_->take_next_sample(&shape, &info) == ReturnCode_t::RETCODE_OK) {
        if (info.valid_data)
          events.samples.push_back({shape.x, shape.color, shape.additional_payload.size()});
      }
    }
    return events;
  }

 private:
  void add_writer(const shapes::Options& options, Topic* topic) {
    PublisherQos group = PUBLISHER_QOS_DEFAULT;
    for (const auto& name : options.partitions) group.partition().push_back(name.c_str());
    DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
    set(qos, options);
    qos.ownership_strength().value = static_cast<uint32_t>(options.strength);
    if (options.lifespan >= 0) qos.lifespan().duration = milliseconds(options.lifespan);
    // Samples above one datagram need a writer that sends from a thread of its own.
    if (options.size > shapes::kDatagram)
      qos.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;
#ifdef HAS_FILTERS
    describe_type();
#endif
    Publisher* publisher = checked(participant_->create_publisher(group), "no publisher");
    writer_ = checked(publisher->create_datawriter(topic, qos), "no writer");
  }

  void add_reader(const shapes::Options& options, Topic* topic) {
    SubscriberQos group = SUBSCRIBER_QOS_DEFAULT;
    for (const auto& name : options.partitions) group.partition().push_back(name.c_str());
    DataReaderQos qos = DATAREADER_QOS_DEFAULT;
    set(qos, options);
    Subscriber* subscriber = checked(participant_->create_subscriber(group), "no subscriber");
    TopicDescription* source = topic;
#ifdef HAS_FILTERS
    if (!options.filter.empty()) {
      describe_type();
      source = checked(participant_->create_contentfilteredtopic("Filtered", topic, options.filter,
                                                                 std::vector<std::string>()),
                       "no filter");
    }
#endif
    reader_ = checked(subscriber->create_datareader(source, qos), "no reader");
  }

  template <typename Qos>
  static void set(Qos& qos, const shapes::Options& options) {
    qos.reliability().kind =
        options.best_effort ? BEST_EFFORT_RELIABILITY_QOS : RELIABLE_RELIABILITY_QOS;
    qos.durability().kind =
        options.transient_local ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
    qos.history().kind = options.keep_all ? KEEP_ALL_HISTORY_QOS : KEEP_LAST_HISTORY_QOS;
    qos.history().depth = options.depth;
    if (options.exclusive) qos.ownership().kind = EXCLUSIVE_OWNERSHIP_QOS;
    if (options.deadline >= 0) qos.deadline().period = milliseconds(options.deadline);
    if (options.lease >= 0) {
      qos.liveliness().lease_duration = milliseconds(options.lease);
      qos.liveliness().announcement_period = milliseconds(options.lease / 2);
    }
    qos.data_sharing().off();
    qos.endpoint().history_memory_policy =
        eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
  }

  template <typename Status>
  static void note(shapes::Events& events, int32_t matched, const Status& incompatible) {
    events.matched = matched;
    if (incompatible.total_count_change > 0)
      events.incompatible.push_back(incompatible.last_policy_id);
  }

  DomainParticipant* participant_;
  DataWriter* writer_ = nullptr;
  DataReader* reader_ = nullptr;
  Shape shape_;
};

}  // namespace

int main(int argc, char** argv) {
  std::set<std::string> missing;
#ifndef HAS_FILTERS
  missing.insert("filter");
#endif
  const auto options = shapes::Options::parse(argc, argv, missing);
  peer::stop_on_signals();
  FastDds fastdds(options);
  shapes::Course(options, "fastdds", fastdds).run();
  return 0;
}
