// Tensors, and the graph of an ONNX file: its constants, and its nodes in an order in which they can be evaluated.
//
// The numbers of the fields are those of onnx.proto, the specification of the format.
#pragma once

#include <fstream>
#include <iterator>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

#include "protobuf.hpp"

using Shape = std::vector<std::int64_t>;

inline std::int64_t entries(const Shape& shape) {
    std::int64_t count = 1;
    for (const std::int64_t size : shape) count *= size;
    return count;
}

// The type of the entries of a tensor. Integers and truth values, 0 and 1, are kept as doubles, too.
enum class Type { single_precision, double_precision, integer };

// A number as a runtime keeps it: in single precision, if that is its type.
inline double rounded(Type type, double value) {
    return type == Type::single_precision ? static_cast<double>(static_cast<float>(value)) : value;
}

struct Tensor {
    Type type = Type::single_precision;
    Shape shape;
    std::vector<double> values;  // the last axis runs fastest

    void round() {
        for (double& value : values) value = rounded(type, value);
    }
};

struct Attribute {
    double number = 0;
    std::int64_t integer = 0;
    std::vector<std::int64_t> integers;
    Tensor tensor;
};

struct Node {
    std::string kind;
    std::vector<std::string> inputs, outputs;
    std::map<std::string, Attribute> attributes;

    std::int64_t integer(const std::string& name, std::int64_t otherwise) const {
        const auto found = attributes.find(name);
        return found == attributes.end() ? otherwise : found->second.integer;
    }
};

struct Graph {
    std::map<std::string, Tensor> constants;
    std::vector<Node> nodes;
    std::vector<std::string> inputs, outputs;
    std::map<std::string, Shape> shapes;  // of the inputs and outputs; -1 stands for the number of states
};

inline Type type_of(std::int64_t code) {
    switch (code) {
        case 1: return Type::single_precision;
        case 11: return Type::double_precision;
        case 6: case 7: case 9: return Type::integer;  // int32, int64, bool
        default: throw std::runtime_error("unsupported type of tensors, number " + std::to_string(code));
    }
}

inline Tensor read_tensor(std::string_view message, std::string* name = nullptr) {
    Tensor tensor;
    std::int64_t code = 0;
    std::string_view raw;
    std::vector<std::int64_t> integers;
    for (const auto& field : protobuf::fields(message)) {
        switch (field.number) {
            case 1: protobuf::append_integers(tensor.shape, field); break;
            case 2: code = static_cast<std::int64_t>(field.integer); break;
            case 4: tensor.values = protobuf::numbers<float>(field.bytes); break;
            case 5: case 7: protobuf::append_integers(integers, field); break;
            case 8: if (name) *name = field.text(); break;
            case 9: raw = field.bytes; break;
            case 10: tensor.values = protobuf::numbers<double>(field.bytes); break;
            default: break;
        }
    }
    tensor.type = type_of(code);
    if (!integers.empty()) tensor.values.assign(integers.begin(), integers.end());
    if (!raw.empty()) {
        switch (code) {
            case 1: tensor.values = protobuf::numbers<float>(raw); break;
            case 6: tensor.values = protobuf::numbers<std::int32_t>(raw); break;
            case 7: tensor.values = protobuf::numbers<std::int64_t>(raw); break;
            case 9: tensor.values = protobuf::numbers<std::uint8_t>(raw); break;
            default: tensor.values = protobuf::numbers<double>(raw); break;
        }
    }
    if (static_cast<std::int64_t>(tensor.values.size()) != entries(tensor.shape)) {
        throw std::runtime_error("expected the entries of a tensor in the ONNX file, got another number of them");
    }
    return tensor;
}

inline Node read_node(std::string_view message) {
    Node node;
    for (const auto& field : protobuf::fields(message)) {
        if (field.number == 1) node.inputs.push_back(field.text());
        if (field.number == 2) node.outputs.push_back(field.text());
        if (field.number == 4) node.kind = field.text();
        if (field.number != 5) continue;
        std::string name;
        Attribute attribute;
        for (const auto& part : protobuf::fields(field.bytes)) {
            if (part.number == 1) name = part.text();
            if (part.number == 2) attribute.number = protobuf::numbers<float>(part.bytes).at(0);
            if (part.number == 3) attribute.integer = static_cast<std::int64_t>(part.integer);
            if (part.number == 5) attribute.tensor = read_tensor(part.bytes);
            if (part.number == 8) protobuf::append_integers(attribute.integers, part);
        }
        node.attributes[name] = attribute;
    }
    return node;
}

// The name of an input or output, whose shape goes to `shapes`.
inline std::string read_port(std::string_view message, std::map<std::string, Shape>& shapes) {
    std::string name;
    Shape shape;
    for (const auto& port : protobuf::fields(message)) {
        if (port.number == 1) name = port.text();
        if (port.number != 2) continue;
        for (const auto& type : protobuf::fields(port.bytes)) {
            for (const auto& part : protobuf::fields(type.bytes)) {
                if (part.number != 2) continue;
                for (const auto& axis : protobuf::fields(part.bytes)) {
                    shape.push_back(-1);
                    for (const auto& size : protobuf::fields(axis.bytes)) {
                        if (size.number == 1) shape.back() = static_cast<std::int64_t>(size.integer);
                    }
                }
            }
        }
    }
    shapes[name] = shape;
    return name;
}

inline Graph read_graph(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error("expected an ONNX file, cannot open " + path);
    const std::string bytes{std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
    Graph graph;
    for (const auto& model : protobuf::fields(bytes)) {
        if (model.number != 7) continue;
        for (const auto& field : protobuf::fields(model.bytes)) {
            std::string name;
            if (field.number == 1) graph.nodes.push_back(read_node(field.bytes));
            if (field.number == 5) {
                Tensor tensor = read_tensor(field.bytes, &name);
                graph.constants[name] = std::move(tensor);
            }
            if (field.number == 11) graph.inputs.push_back(read_port(field.bytes, graph.shapes));
            if (field.number == 12) graph.outputs.push_back(read_port(field.bytes, graph.shapes));
        }
    }
    if (graph.nodes.empty()) throw std::runtime_error("expected an ONNX file with a graph, got " + path);
    return graph;
}
