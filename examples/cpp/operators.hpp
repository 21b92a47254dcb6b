// The operators of ONNX (opset 18 and later) that models of pirl_rl use, on tensors of any shape.
#pragma once

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <set>

#include "graph.hpp"

using Arguments = std::vector<const Tensor*>;  // a null pointer stands for an argument that is left out

// How far the flat index moves along each axis of `shape`; 0 along an axis that is broadcast to `wide`.
inline Shape strides(const Shape& shape, const Shape& wide) {
    Shape steps(wide.size(), 0);
    std::int64_t step = 1;
    for (std::size_t k = 1; k <= shape.size(); ++k) {
        const std::int64_t size = shape[shape.size() - k];
        if (size != 1) steps[wide.size() - k] = step;
        step *= size;
    }
    return steps;
}

// Calls `visit(i, j)` for each flat index i of a tensor of the given shape, where j moves by `steps` along its axes.
template <class Visit>
void walk(const Shape& shape, const Shape& steps, std::int64_t start, Visit visit) {
    Shape index(shape.size(), 0);
    std::int64_t j = start;
    for (std::int64_t i = 0, count = entries(shape); i < count; ++i) {
        visit(i, j);
        for (std::size_t axis = shape.size(); axis-- > 0;) {
            j += steps[axis];
            if (++index[axis] < shape[axis]) break;
            j -= steps[axis] * shape[axis];
            index[axis] = 0;
        }
    }
}

// The values of a tensor, read along `steps` from `start`, as a tensor of the given shape.
inline Tensor gathered(const Tensor& x, const Shape& shape, const Shape& steps, std::int64_t start = 0) {
    Tensor y{x.type, shape, std::vector<double>(static_cast<std::size_t>(entries(shape)))};
    walk(shape, steps, start, [&](std::int64_t i, std::int64_t j) { y.values[i] = x.values[j]; });
    return y;
}

inline Tensor broadcast(const Tensor& x, const Shape& shape) { return gathered(x, shape, strides(x.shape, shape)); }

inline Shape common_shape(const Shape& a, const Shape& b) {
    Shape shape(std::max(a.size(), b.size()), 1);
    for (std::size_t k = 1; k <= shape.size(); ++k) {
        const std::int64_t one = k <= a.size() ? a[a.size() - k] : 1, other = k <= b.size() ? b[b.size() - k] : 1;
        if (one != other && one != 1 && other != 1) throw std::runtime_error("two shapes do not fit together");
        shape[shape.size() - k] = one == 1 ? other : one;
    }
    return shape;
}

inline std::size_t axis_of(std::int64_t axis, std::size_t rank) {
    return static_cast<std::size_t>(axis < 0 ? axis + static_cast<std::int64_t>(rank) : axis);
}

inline Shape to_shape(const Tensor& x) { return Shape(x.values.begin(), x.values.end()); }

// The axes that the second argument or an attribute gives; without them, all.
inline std::set<std::size_t> axes_of(const Node& node, const Arguments& in, std::size_t rank) {
    Shape given;
    if (in.size() > 1 && in[1]) given = to_shape(*in[1]);
    if (const auto found = node.attributes.find("axes"); found != node.attributes.end()) given = found->second.integers;
    std::set<std::size_t> axes;
    for (const std::int64_t axis : given) axes.insert(axis_of(axis, rank));
    for (std::size_t axis = 0; given.empty() && axis < rank; ++axis) axes.insert(axis);
    return axes;
}

inline double sigmoid(double z) { return z < 0 ? std::exp(z) / (1 + std::exp(z)) : 1 / (1 + std::exp(-z)); }

using Unary = std::function<double(double)>;
using Binary = std::function<double(double, double)>;

// Functions of one entry.
inline const std::map<std::string, Unary>& unary_operators() {
    static const std::map<std::string, Unary> table = {
        {"Abs", [](double z) { return std::fabs(z); }},
        {"Acos", [](double z) { return std::acos(z); }},
        {"Acosh", [](double z) { return std::acosh(z); }},
        {"Asin", [](double z) { return std::asin(z); }},
        {"Asinh", [](double z) { return std::asinh(z); }},
        {"Atan", [](double z) { return std::atan(z); }},
        {"Atanh", [](double z) { return std::atanh(z); }},
        {"Ceil", [](double z) { return std::ceil(z); }},
        {"Cos", [](double z) { return std::cos(z); }},
        {"Cosh", [](double z) { return std::cosh(z); }},
        {"Erf", [](double z) { return std::erf(z); }},
        {"Exp", [](double z) { return std::exp(z); }},
        {"Floor", [](double z) { return std::floor(z); }},
        {"Identity", [](double z) { return z; }},
        {"IsInf", [](double z) { return double(std::isinf(z)); }},
        {"IsNaN", [](double z) { return double(std::isnan(z)); }},
        {"Log", [](double z) { return std::log(z); }},
        {"Neg", [](double z) { return -z; }},
        {"Not", [](double z) { return double(z == 0); }},
        {"Reciprocal", [](double z) { return 1 / z; }},
        {"Relu", [](double z) { return std::max(z, 0.0); }},
        {"Sigmoid", sigmoid},
        {"Sign", [](double z) { return double((z > 0) - (z < 0)); }},
        {"Sin", [](double z) { return std::sin(z); }},
        {"Sinh", [](double z) { return std::sinh(z); }},
        {"Softplus", [](double z) { return std::max(z, 0.0) + std::log1p(std::exp(-std::fabs(z))); }},
        {"Sqrt", [](double z) { return std::sqrt(z); }},
        {"Tan", [](double z) { return std::tan(z); }},
        {"Tanh", [](double z) { return std::tanh(z); }},
    };
    return table;
}

// Functions of two entries; Max and Min take any number of tensors, one after the other.
inline const std::map<std::string, Binary>& binary_operators() {
    static const std::map<std::string, Binary> table = {
        {"Add", [](double a, double b) { return a + b; }},
        {"And", [](double a, double b) { return double(a != 0 && b != 0); }},
        {"Div", [](double a, double b) { return a / b; }},
        {"Equal", [](double a, double b) { return double(a == b); }},
        {"Greater", [](double a, double b) { return double(a > b); }},
        {"GreaterOrEqual", [](double a, double b) { return double(a >= b); }},
        {"Less", [](double a, double b) { return double(a < b); }},
        {"LessOrEqual", [](double a, double b) { return double(a <= b); }},
        {"Max", [](double a, double b) { return std::max(a, b); }},
        {"Min", [](double a, double b) { return std::min(a, b); }},
        {"Mul", [](double a, double b) { return a * b; }},
        {"Or", [](double a, double b) { return double(a != 0 || b != 0); }},
        {"Pow", [](double a, double b) { return std::pow(a, b); }},
        {"Sub", [](double a, double b) { return a - b; }},
        {"Xor", [](double a, double b) { return double((a != 0) != (b != 0)); }},
    };
    return table;
}

// Reductions: the value that begins, and how an entry, for ReduceL2 its square, joins it.
inline const std::map<std::string, std::pair<double, Binary>>& reductions() {
    constexpr double infinity = std::numeric_limits<double>::infinity();
    static const std::map<std::string, std::pair<double, Binary>> table = {
        {"ReduceL2", {0.0, [](double sum, double z) { return sum + z; }}},
        {"ReduceMax", {-infinity, [](double a, double b) { return std::max(a, b); }}},
        {"ReduceMean", {0.0, [](double sum, double z) { return sum + z; }}},
        {"ReduceMin", {infinity, [](double a, double b) { return std::min(a, b); }}},
        {"ReduceProd", {1.0, [](double product, double z) { return product * z; }}},
        {"ReduceSum", {0.0, [](double sum, double z) { return sum + z; }}},
    };
    return table;
}

inline Tensor apply(const Tensor& a, const Tensor& b, const std::string& kind, const Binary& function) {
    static const std::set<std::string> truths = {"And", "Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual",
                                                 "Or", "Xor"};
    const Shape shape = common_shape(a.shape, b.shape);
    Tensor y = broadcast(a, shape);
    walk(shape, strides(b.shape, shape), 0, [&](std::int64_t i, std::int64_t j) {
        y.values[i] = function(y.values[i], b.values[j]);
        if (kind == "Div" && a.type == Type::integer) y.values[i] = std::trunc(y.values[i]);
    });
    if (truths.count(kind)) y.type = Type::integer;
    return y;
}

inline Tensor reduce(const Node& node, const Arguments& in) {
    const Tensor& x = *in.at(0);
    if (node.integer("noop_with_empty_axes", 0) != 0) throw std::runtime_error("unsupported: a reduction of no axes");
    const auto axes = axes_of(node, in, x.shape.size());
    Shape kept, squeezed;
    for (std::size_t axis = 0; axis < x.shape.size(); ++axis) {
        kept.push_back(axes.count(axis) ? 1 : x.shape[axis]);
        if (!axes.count(axis)) squeezed.push_back(x.shape[axis]);
    }
    const auto& [start, join] = reductions().at(node.kind);
    Tensor y{x.type, kept, std::vector<double>(static_cast<std::size_t>(entries(kept)), start)};
    // Every step is rounded, so that the level of a state on a face is the one that a runtime computes.
    walk(x.shape, strides(kept, x.shape), 0, [&](std::int64_t i, std::int64_t j) {
        const double z = node.kind == "ReduceL2" ? rounded(x.type, x.values[i] * x.values[i]) : x.values[i];
        y.values[j] = rounded(x.type, join(y.values[j], z));
    });
    const double count = static_cast<double>(x.values.size()) / static_cast<double>(y.values.size());
    for (double& value : y.values) {
        if (node.kind == "ReduceMean") value /= count;
        if (node.kind == "ReduceL2") value = std::sqrt(value);
    }
    if (node.integer("keepdims", 1) == 0) y.shape = squeezed;
    return y;
}
