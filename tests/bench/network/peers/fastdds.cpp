// Fast DDS: RTPS over UDP only, with a type of plain bytes. Best effort keeps the newest sample, as ddx does by default;
// reliable keeps and repeats them all.
#include "peer.h"

#include <memory>
#include <string>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

using namespace eprosima::fastdds::dds;
using eprosima::fastdds::rtps::UDPv4TransportDescriptor;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

namespace {

// What is sent points at the sample that `publish` was given; what is read lies in a buffer that grows once.
struct Bytes {
    uint8_t *data = nullptr;
    size_t size = 0;
    std::vector<uint8_t> own;
};

// Four bytes of encapsulation, four of length, then the bytes.
class BytesType : public TopicDataType {
public:
    BytesType() {
        setName("bench::Bytes");
        m_typeSize = SIZE_MAX_BYTES + 8;
        m_isGetKeyDefined = false;
    }

    bool serialize(void *data, SerializedPayload_t *payload) override {
        auto *bytes = static_cast<Bytes *>(data);
        const uint8_t head[4] = {0, 1, 0, 0};
        const auto size = static_cast<uint32_t>(bytes->size);
        memcpy(payload->data, head, 4);
        memcpy(payload->data + 4, &size, 4);
        memcpy(payload->data + 8, bytes->data, bytes->size);
        payload->encapsulation = CDR_LE;
        payload->length = size + 8;
        return true;
    }

    bool deserialize(SerializedPayload_t *payload, void *data) override {
        auto *bytes = static_cast<Bytes *>(data);
        uint32_t size = 0;
        if (payload->length < 8) {
            return false;
        }
        memcpy(&size, payload->data + 4, 4);
        if (size > payload->length - 8) {
            return false;
        }
        bytes->own.assign(payload->data + 8, payload->data + 8 + size);
        bytes->data = bytes->own.data();
        bytes->size = size;
        return true;
    }

    std::function<uint32_t()> getSerializedSizeProvider(void *data) override {
        return [data] { return static_cast<uint32_t>(static_cast<Bytes *>(data)->size) + 8; };
    }

    void *createData() override { return new Bytes; }

    void deleteData(void *data) override { delete static_cast<Bytes *>(data); }

    bool getKey(void *, InstanceHandle_t *, bool) override { return false; }
};

class OnData : public DataReaderListener {
    void on_data_available(DataReader *reader) override {
        SampleInfo info;
        while (reader->take_next_sample(&bytes_, &info) == ReturnCode_t::RETCODE_OK) {
            if (info.valid_data) {
                take(bytes_.data, bytes_.size);
            }
        }
    }

    Bytes bytes_;
};

std::vector<DataWriter *> writers;
OnData on_data;

template <typename Qos> void set_qos(Qos &qos, const struct options *options) {
    if (options->reliable) {
        qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
        qos.reliability().max_blocking_time = {10, 0};
        qos.history().kind = KEEP_ALL_HISTORY_QOS;
    } else {
        qos.reliability().kind = BEST_EFFORT_RELIABILITY_QOS;
        qos.history().kind = KEEP_LAST_HISTORY_QOS;
        qos.history().depth = 1;
    }
    qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::DYNAMIC_REUSABLE_MEMORY_MODE;
}

DomainParticipant *join_domain() {
    DomainParticipantQos qos;
    auto udp = std::make_shared<UDPv4TransportDescriptor>();
    udp->sendBufferSize = SOCKET_BUFFER_BYTES;
    udp->receiveBufferSize = SOCKET_BUFFER_BYTES;
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    qos.name("bench");
    auto *participant = DomainParticipantFactory::get_instance()->create_participant(0, qos);
    if (participant == nullptr) {
        fail("create_participant");
    }
    TypeSupport(new BytesType).register_type(participant);
    return participant;
}

Topic *make_topic(DomainParticipant *participant, int item) {
    return participant->create_topic("bench_" + std::to_string(item), "bench::Bytes", TOPIC_QOS_DEFAULT);
}

} // namespace

static void open_publisher(const struct options *options) {
    auto *participant = join_domain();
    auto *publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
    DataWriterQos qos;
    set_qos(qos, options);
    for (int item = 0; item < options->items; item++) {
        writers.push_back(publisher->create_datawriter(make_topic(participant, item), qos));
        if (writers.back() == nullptr) {
            fail("create_datawriter");
        }
    }
}

static void open_subscriber(const struct options *options) {
    auto *participant = join_domain();
    auto *subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    DataReaderQos qos;
    set_qos(qos, options);
    for (int item = 0; item < options->items; item++) {
        if (subscriber->create_datareader(make_topic(participant, item), qos, &on_data) == nullptr) {
            fail("create_datareader");
        }
    }
}

static const char *publish(int item, uint8_t *sample, size_t size) {
    Bytes bytes;
    bytes.data = sample;
    bytes.size = size;
    // False is a history that is full: the sample is lost.
    (void)writers[static_cast<size_t>(item)]->write(&bytes);
    return nullptr;
}
