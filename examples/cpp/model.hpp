// A model: the graph of an ONNX file, evaluated node by node.
#pragma once

#include "layout.hpp"

// The results of a node at its arguments.
inline std::vector<Tensor> evaluate(const Node& node, const Arguments& in) {
    const std::string& kind = node.kind;
    const auto given = [&](std::size_t k) { return k < in.size() && in[k]; };
    if (kind == "Split") return split(node, in);
    if (kind == "Constant") return {node.attributes.at("value").tensor};
    const Tensor& x = *in.at(0);
    if (const auto found = unary_operators().find(kind); found != unary_operators().end()) {
        Tensor y = x;
        for (double& value : y.values) value = found->second(value);
        if (kind == "Not" || kind == "IsNaN" || kind == "IsInf") y.type = Type::integer;
        return {y};
    }
    if (const auto found = binary_operators().find(kind); found != binary_operators().end()) {
        Tensor y = x;
        for (std::size_t k = 1; k < in.size(); ++k) y = apply(y, *in[k], kind, found->second);
        return {y};
    }
    if (reductions().count(kind)) return {reduce(node, in)};
    if (kind == "MatMul") return {product(x, *in.at(1))};
    if (kind == "Gemm") {
        const auto factor = [&](const char* name) {
            return node.attributes.count(name) ? node.attributes.at(name).number : 1.0;
        };
        Tensor y = product(node.integer("transA", 0) ? transposed(x) : x,
                           node.integer("transB", 0) ? transposed(*in.at(1)) : *in.at(1));
        for (double& value : y.values) value *= factor("alpha");
        if (!given(2)) return {y};
        return {apply(y, *in[2], kind, [&](double a, double b) { return a + factor("beta") * b; })};
    }
    if (kind == "Where") {
        const Shape shape = common_shape(common_shape(x.shape, in.at(1)->shape), in.at(2)->shape);
        Tensor y = broadcast(*in[1], shape);
        const Tensor condition = broadcast(x, shape), otherwise = broadcast(*in[2], shape);
        for (std::size_t i = 0; i < y.values.size(); ++i) {
            if (condition.values[i] == 0) y.values[i] = otherwise.values[i];
        }
        return {y};
    }
    if (kind == "Clip") {
        Tensor y = x;
        for (double& value : y.values) {
            if (given(1) && value < in[1]->values[0]) value = in[1]->values[0];
            if (given(2) && value > in[2]->values[0]) value = in[2]->values[0];
        }
        return {y};
    }
    if (kind == "Cast") {
        Tensor y = x;
        const std::int64_t code = node.integer("to", 1);
        y.type = type_of(code);
        for (double& value : y.values) {
            if (code == 9) value = value != 0;
            else if (y.type == Type::integer) value = std::trunc(value);
        }
        return {y};
    }
    if (kind == "Concat") return {concatenate(in, node.integer("axis", 0))};
    if (kind == "Slice") return {slice(in)};
    if (kind == "Reshape") return {reshape(x, to_shape(*in.at(1)))};
    if (kind == "Unsqueeze") return {unsqueeze(x, to_shape(*in.at(1)))};
    if (kind == "Squeeze") return {squeeze(x, axes_of(node, in, x.shape.size()))};
    if (kind == "Expand") return {broadcast(x, common_shape(x.shape, to_shape(*in.at(1))))};
    if (kind == "Gather") return {gather(x, *in.at(1), node.integer("axis", 0))};
    if (kind == "GatherND" && node.integer("batch_dims", 0) == 0) return {gather_tuples(x, *in.at(1))};
    if (kind == "Transpose") return {transpose(x, node.attributes.at("perm").integers)};
    if (kind == "Shape") {
        const auto rank = static_cast<std::int64_t>(x.shape.size());
        const Tensor sizes{Type::integer, {rank}, std::vector<double>(x.shape.begin(), x.shape.end())};
        const std::int64_t start = node.integer("start", 0), end = std::min(rank, node.integer("end", rank));
        return {cut(sizes, 0, start, 1, end - start)};
    }
    throw std::runtime_error("unsupported operator " + kind + ": evaluate this model with onnxruntime");
}

class Model {
public:
    explicit Model(const std::string& path) : graph_(read_graph(path)) {}

    const std::vector<std::string>& outputs() const { return graph_.outputs; }

    // The number n of coordinates of a state.
    std::int64_t states() const { return graph_.shapes.at("x").at(1); }

    // The outputs by name at times to go tau (N,) in s and states x (N, n) in SI units.
    std::map<std::string, Tensor> operator()(const std::vector<double>& tau, const std::vector<double>& x) const {
        const auto count = static_cast<std::int64_t>(tau.size());
        std::map<std::string, Tensor> known;
        known["tau"] = Tensor{Type::single_precision, {count}, tau};
        known["x"] = Tensor{Type::single_precision, {count, states()}, x};
        for (auto& entry : known) entry.second.round();
        for (const Node& node : graph_.nodes) {
            Arguments arguments;
            for (const std::string& name : node.inputs) {
                const auto constant = graph_.constants.find(name);
                arguments.push_back(name.empty() ? nullptr
                                    : constant != graph_.constants.end() ? &constant->second : &known.at(name));
            }
            std::vector<Tensor> results = evaluate(node, arguments);
            for (std::size_t k = 0; k < node.outputs.size(); ++k) {
                results.at(k).round();
                known[node.outputs[k]] = std::move(results[k]);
            }
        }
        std::map<std::string, Tensor> answer;
        for (const std::string& name : graph_.outputs) answer[name] = known.at(name);
        return answer;
    }

private:
    Graph graph_;
};
