// Print the areas and arcs of the map whenever they change, without ROS: by Fast DDS 2 and nlohmann-json.
//   apt install g++ libfastrtps-dev nlohmann-json3-dev
//   g++ -std=c++17 graph_consumer.cpp -o graph_consumer -lfastrtps -lfastcdr
//   ./graph_consumer [TOPIC [NUMBER OF MESSAGES, 0 for no end [SECONDS TO WAIT FOR THE FIRST]]]
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <nlohmann/json.hpp>

using namespace eprosima::fastdds::dds;
using nlohmann::json;
using Payload = eprosima::fastrtps::rtps::SerializedPayload_t;

// std_msgs/String on the wire: 4 bytes for the encoding, 4 for the length with a zero at the end, the text.
struct StringType : TopicDataType {
    StringType() { setName("std_msgs::msg::dds_::String_"); m_typeSize = 1 << 16; }
    bool deserialize(Payload* payload, void* data) override {
        uint32_t length = 0;
        if (payload->length >= 8) std::memcpy(&length, payload->data + 4, 4);
        if (length == 0 || length > payload->length - 8) return false;
        static_cast<std::string*>(data)->assign(reinterpret_cast<char*>(payload->data) + 8, length - 1);
        return true;
    }
    bool serialize(void*, Payload*) override { return false; }  // it only listens
    std::function<uint32_t()> getSerializedSizeProvider(void*) override { return [] { return 0u; }; }
    bool getKey(void*, eprosima::fastrtps::rtps::InstanceHandle_t*, bool) override { return false; }
    void* createData() override { return new std::string; }
    void deleteData(void* data) override { delete static_cast<std::string*>(data); }
};

void print_pose(const json& pose) { std::printf("(%.2f, %.2f, %.2f)", double(pose[0]), double(pose[1]), double(pose[2])); }

// Print a document; docs/reference/schemas/topology.schema.json has its fields.
void print_topology(const json& map) {
    std::printf("event %ld: %zu hypotheses, the best %.3f\nrobot: area %ld, ", long(map["events"]), map["hypotheses"].size(),
                double(map["hypotheses"][0]["probability"]), long(map["area"]));
    print_pose(map["pose"]);
    for (const json& area : map["areas"]) {
        std::printf("\narea %ld: ", long(area["area"]));
        print_pose(area["pose"]["mean"]);
        std::printf(", %zu keyframes", area["keyframes"].size());
    }
    for (const json& arc : map["arcs"]) {
        std::printf("\n%s %ld -> %ld: ", arc["closure"] ? "closure" : "arc", long(arc["source"]), long(arc["target"]));
        print_pose(arc["pose"]["mean"]);
        std::printf(", probability %.3f", double(arc["probability"]));
    }
    std::puts("");
    std::fflush(stdout);
}

int main(int count, char** words) {
    const std::string topic_name = count > 1 ? words[1] : "hmt/topology";
    const int wanted = count > 2 ? std::atoi(words[2]) : 0, patience = count > 3 ? std::atoi(words[3]) : 10;
    const char* domain = std::getenv("ROS_DOMAIN_ID");
    DomainParticipantQos participant_qos;  // over UDP alone: the shared memory of other versions may differ
    participant_qos.transport().use_builtin_transports = false;
    participant_qos.transport().user_transports.push_back(std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>());
    auto* participant = DomainParticipantFactory::get_instance()->create_participant(domain ? std::atoi(domain) : 0, participant_qos);
    TypeSupport type(new StringType);
    type.register_type(participant);
    auto* topic = participant->create_topic("rt/" + topic_name, type.get_type_name(), TOPIC_QOS_DEFAULT);
    DataReaderQos qos;  // the newest map, also if it is old
    qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
    qos.durability().kind = TRANSIENT_LOCAL_DURABILITY_QOS;
    auto* reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, qos);
    int received = 0;
    while (received == 0 || received != wanted) {
        if (!reader->wait_for_unread_message({received ? 3600 : patience, 0}) && received == 0) {
            std::printf("nothing came on %s within %d s: start the nodes, or set ROS_DOMAIN_ID as theirs is\n",
                        topic_name.c_str(), patience);
            break;
        }
        std::string text;
        SampleInfo info;
        while (reader->take_next_sample(&text, &info) == ReturnCode_t::RETCODE_OK)
            if (info.valid_data) ++received, print_topology(json::parse(text));
    }
    participant->delete_contained_entities();
    DomainParticipantFactory::get_instance()->delete_participant(participant);
    return received ? 0 : 1;
}
