// Passes messages as Fast DDS passes them to its shared memory: to a function of the same name and
// parameters. 2.x passes one buffer, and 3.x, with -DLIST, a list of buffers.
//
// An input line has the lengths of the buffers, a colon, and the message in hexadecimal digits. The
// line `nowhere` stands for a message at an unmapped address. Prints `handed` after each line.
#include <chrono>
#include <cstdint>
#include <iostream>
#include <memory>
#include <sstream>
#include <string>
#include <vector>

namespace eprosima {
namespace fastdds {
namespace rtps {

struct NetworkBuffer {
  const void* buffer;
  uint32_t size;
};

using Until = std::chrono::steady_clock::time_point;

class SharedMemTransport {
 public:
#ifdef LIST
  using Message = const std::vector<NetworkBuffer>&;
#else
  using Message = const unsigned char*;
#endif
  std::shared_ptr<uint32_t> copy_to_shared_buffer(Message message, uint32_t size,
                                                  const Until& until);
};

__attribute__((noinline)) std::shared_ptr<uint32_t> SharedMemTransport::copy_to_shared_buffer(
    Message, uint32_t size, const Until&) {
  return std::make_shared<uint32_t>(size);
}

}  // namespace rtps
}  // namespace fastdds
}  // namespace eprosima

using eprosima::fastdds::rtps::NetworkBuffer;

int main() {
  eprosima::fastdds::rtps::SharedMemTransport transport;
  const auto until = std::chrono::steady_clock::now();
  const auto nowhere = reinterpret_cast<const unsigned char*>(8);
  std::cout << "ready" << std::endl;
  for (std::string line; std::getline(std::cin, line);) {
    std::vector<uint32_t> lengths;
    std::vector<unsigned char> bytes;
    const size_t colon = line.find(':');
    if (colon != std::string::npos) {
      std::istringstream words(line.substr(0, colon));
      for (uint32_t length; words >> length;) lengths.push_back(length);
      for (size_t at = colon + 1; at + 1 < line.size(); at += 2)
        bytes.push_back(std::stoul(line.substr(at, 2), nullptr, 16));
    }
    const unsigned char* message = bytes.empty() ? nowhere : bytes.data();
    const uint32_t size = bytes.empty() ? 100 : bytes.size();
#ifdef LIST
    std::vector<NetworkBuffer> buffers;
    // Each buffer is in separate memory.
    std::vector<std::vector<unsigned char>> parts;
    size_t at = 0;
    for (uint32_t length : lengths) {
      parts.emplace_back(message + at, message + at + length);
      at += length;
    }
    for (const auto& part : parts)
      buffers.push_back({part.data(), static_cast<uint32_t>(part.size())});
    if (buffers.empty()) buffers.push_back({nowhere, size});
    transport.copy_to_shared_buffer(buffers, size, until);
#else
    transport.copy_to_shared_buffer(message, size, until);
#endif
    std::cout << "handed" << std::endl;
  }
}
