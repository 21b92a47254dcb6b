// Reading of messages of Protocol Buffers, the encoding of ONNX files.
//
// A message is a sequence of fields. Each has a number, and an integer, eight or four bytes, or a string of bytes as its
// entry; a string of bytes may be a text, a message in turn, or many packed numbers.
#pragma once

#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace protobuf {

// One field: its number, and its entry as an integer or as bytes.
struct Field {
    int number = 0;
    std::uint64_t integer = 0;
    std::string_view bytes;

    std::string text() const { return std::string(bytes); }
};

inline std::uint64_t read_integer(std::string_view& rest) {
    std::uint64_t value = 0;
    for (int shift = 0; shift < 64; shift += 7) {
        if (rest.empty()) break;
        const auto byte = static_cast<unsigned char>(rest.front());
        rest.remove_prefix(1);
        value |= static_cast<std::uint64_t>(byte & 0x7f) << shift;
        if (byte < 0x80) return value;
    }
    throw std::runtime_error("expected an ONNX file, got an integer without an end");
}

inline std::string_view read_bytes(std::string_view& rest, std::uint64_t size) {
    if (size > rest.size()) throw std::runtime_error("expected a whole ONNX file, got one that is cut short");
    const std::string_view bytes = rest.substr(0, size);
    rest.remove_prefix(size);
    return bytes;
}

// The fields of a message, in their order.
inline std::vector<Field> fields(std::string_view message) {
    std::vector<Field> found;
    while (!message.empty()) {
        const std::uint64_t key = read_integer(message);
        Field field;
        field.number = static_cast<int>(key >> 3);
        switch (key & 7) {
            case 0: field.integer = read_integer(message); break;
            case 1: field.bytes = read_bytes(message, 8); break;
            case 2: field.bytes = read_bytes(message, read_integer(message)); break;
            case 5: field.bytes = read_bytes(message, 4); break;
            default: throw std::runtime_error("expected an ONNX file, got a field of an unknown kind");
        }
        found.push_back(field);
    }
    return found;
}

// Numbers of the C++ type T that lie one after the other in bytes, as doubles.
template <class T>
std::vector<double> numbers(std::string_view bytes) {
    std::vector<double> values(bytes.size() / sizeof(T));
    for (std::size_t i = 0; i < values.size(); ++i) {
        T value;
        std::memcpy(&value, bytes.data() + i * sizeof(T), sizeof(T));
        values[i] = static_cast<double>(value);
    }
    return values;
}

// The integers of a repeated field, which is either packed into bytes or occurs once for each of them.
inline void append_integers(std::vector<std::int64_t>& values, const Field& field) {
    if (field.bytes.empty()) {
        values.push_back(static_cast<std::int64_t>(field.integer));
        return;
    }
    for (std::string_view rest = field.bytes; !rest.empty();) {
        values.push_back(static_cast<std::int64_t>(read_integer(rest)));
    }
}

}  // namespace protobuf
