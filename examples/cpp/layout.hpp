// Operators that move entries, and products of matrices.
#pragma once

#include "operators.hpp"

// A x B of matrices in the last two axes; the axes before them are broadcast.
inline Tensor product(const Tensor& a, const Tensor& b) {
    const std::size_t p = a.shape.size(), q = b.shape.size();
    if (p < 2 || q < 2) throw std::runtime_error("unsupported: MatMul of a vector");
    const std::int64_t rows = a.shape[p - 2], inner = a.shape[p - 1], columns = b.shape[q - 1];
    if (inner != b.shape[q - 2]) throw std::runtime_error("the shapes of a product of matrices do not fit together");
    const Shape a_stack(a.shape.begin(), a.shape.end() - 2), b_stack(b.shape.begin(), b.shape.end() - 2);
    const Shape stack = common_shape(a_stack, b_stack), from_a = strides(a_stack, stack);
    Shape shape = stack;
    shape.insert(shape.end(), {rows, columns});
    Tensor y{a.type, shape, std::vector<double>(static_cast<std::size_t>(entries(shape)), 0.0)};
    std::vector<std::int64_t> a_start(static_cast<std::size_t>(entries(stack)));
    walk(stack, from_a, 0, [&](std::int64_t i, std::int64_t j) { a_start[i] = j * rows * inner; });
    walk(stack, strides(b_stack, stack), 0, [&](std::int64_t i, std::int64_t j) {
        for (std::int64_t r = 0; r < rows; ++r) {
            double* const row = &y.values[(i * rows + r) * columns];
            for (std::int64_t k = 0; k < inner; ++k) {
                const double factor = a.values[a_start[i] + r * inner + k];
                const double* const other = &b.values[(j * inner + k) * columns];
                for (std::int64_t c = 0; c < columns; ++c) row[c] += factor * other[c];
            }
        }
    });
    return y;
}

// The entries along new axes, where axis i of the result is axis `order[i]` of x.
inline Tensor transpose(const Tensor& x, const Shape& order) {
    const Shape steps = strides(x.shape, x.shape);
    Shape shape, moved;
    for (const std::int64_t axis : order) {
        shape.push_back(x.shape[axis]);
        moved.push_back(steps[axis]);
    }
    return gathered(x, shape, moved);
}

inline Tensor transposed(const Tensor& x) { return transpose(x, {1, 0}); }

inline Tensor concatenate(const Arguments& in, std::int64_t given) {
    const std::size_t axis = axis_of(given, in.at(0)->shape.size());
    Shape shape = in[0]->shape;
    shape[axis] = 0;
    for (const Tensor* part : in) shape[axis] += part->shape[axis];
    Tensor y{in[0]->type, shape, std::vector<double>(static_cast<std::size_t>(entries(shape)))};
    std::int64_t start = 0;
    for (const Tensor* part : in) {
        const Shape steps = strides(shape, shape);
        walk(part->shape, steps, start, [&](std::int64_t i, std::int64_t j) { y.values[j] = part->values[i]; });
        start += steps[axis] * part->shape[axis];
    }
    return y;
}

// The entries `start`, `start + step`, ... of one axis, `count` of them.
inline Tensor cut(const Tensor& x, std::size_t axis, std::int64_t start, std::int64_t step, std::int64_t count) {
    Shape shape = x.shape, steps = strides(x.shape, x.shape);
    const std::int64_t offset = start * steps[axis];
    shape[axis] = count;
    steps[axis] *= step;
    return gathered(x, shape, steps, offset);
}

inline Tensor slice(const Arguments& in) {
    Tensor y = *in.at(0);
    const Shape starts = to_shape(*in.at(1)), ends = to_shape(*in.at(2));
    for (std::size_t k = 0; k < starts.size(); ++k) {
        const std::size_t axis = in.size() > 3 && in[3] ? axis_of(to_shape(*in[3])[k], y.shape.size()) : k;
        const std::int64_t step = in.size() > 4 && in[4] ? to_shape(*in[4])[k] : 1, size = y.shape[axis];
        if (step < 1) throw std::runtime_error("unsupported: a slice that runs backwards");
        const auto place = [size](std::int64_t i) { return std::clamp<std::int64_t>(i < 0 ? i + size : i, 0, size); };
        const std::int64_t start = place(starts[k]), end = std::max(start, place(ends[k]));
        y = cut(y, axis, start, step, (end - start + step - 1) / step);
    }
    return y;
}

inline std::vector<Tensor> split(const Node& node, const Arguments& in) {
    const Tensor& x = *in.at(0);
    const std::size_t axis = axis_of(node.integer("axis", 0), x.shape.size());
    const auto count = static_cast<std::int64_t>(node.outputs.size());
    Shape sizes(node.outputs.size(), (x.shape[axis] + count - 1) / count);
    sizes.back() = x.shape[axis] - (count - 1) * sizes.front();
    if (in.size() > 1 && in[1]) sizes = to_shape(*in[1]);
    std::vector<Tensor> parts;
    std::int64_t start = 0;
    for (const std::int64_t size : sizes) {
        parts.push_back(cut(x, axis, start, 1, size));
        start += size;
    }
    return parts;
}

inline Tensor reshape(Tensor x, Shape shape) {
    std::int64_t known = 1;
    for (std::size_t axis = 0; axis < shape.size(); ++axis) {
        if (shape[axis] == 0) shape[axis] = x.shape.at(axis);
        if (shape[axis] > 0) known *= shape[axis];
    }
    for (std::int64_t& size : shape) {
        if (size == -1) size = static_cast<std::int64_t>(x.values.size()) / known;
    }
    x.shape = shape;
    return x;
}

inline Tensor unsqueeze(Tensor x, const Shape& axes) {
    const std::size_t rank = x.shape.size() + axes.size();
    std::set<std::size_t> added;
    for (const std::int64_t axis : axes) added.insert(axis_of(axis, rank));
    for (const std::size_t axis : added) x.shape.insert(x.shape.begin() + static_cast<std::ptrdiff_t>(axis), 1);
    return x;
}

inline Tensor squeeze(Tensor x, const std::set<std::size_t>& axes) {
    Shape shape;
    for (std::size_t axis = 0; axis < x.shape.size(); ++axis) {
        if (x.shape[axis] != 1 || !axes.count(axis)) shape.push_back(x.shape[axis]);
    }
    x.shape = shape;
    return x;
}

// The entries of x at the tuples of indices in the last axis of `index`, as GatherND without batch axes.
inline Tensor gather_tuples(const Tensor& x, const Tensor& index) {
    const auto depth = static_cast<std::size_t>(index.shape.back());
    const Shape tail(x.shape.begin() + static_cast<std::ptrdiff_t>(depth), x.shape.end());
    const std::int64_t size = entries(tail);
    Shape shape(index.shape.begin(), index.shape.end() - 1);
    const std::int64_t count = entries(shape);
    shape.insert(shape.end(), tail.begin(), tail.end());
    Tensor y{x.type, shape, {}};
    for (std::int64_t i = 0; i < count; ++i) {
        std::int64_t place = 0;
        for (std::size_t k = 0; k < depth; ++k) {
            const auto entry = static_cast<std::int64_t>(index.values[i * depth + k]);
            place = place * x.shape[k] + (entry < 0 ? entry + x.shape[k] : entry);
        }
        const auto start = x.values.begin() + place * size;
        y.values.insert(y.values.end(), start, start + size);
    }
    return y;
}

// The slices of x at the indices along one axis.
inline Tensor gather(const Tensor& x, const Tensor& index, std::int64_t given) {
    const std::size_t axis = axis_of(given, x.shape.size());
    const Shape head(x.shape.begin(), x.shape.begin() + static_cast<std::ptrdiff_t>(axis));
    const Shape tail(x.shape.begin() + static_cast<std::ptrdiff_t>(axis) + 1, x.shape.end());
    const std::int64_t outer = entries(head), inner = entries(tail), size = x.shape[axis];
    Shape shape = head;
    shape.insert(shape.end(), index.shape.begin(), index.shape.end());
    shape.insert(shape.end(), tail.begin(), tail.end());
    Tensor y{x.type, shape, {}};
    for (std::int64_t i = 0; i < outer; ++i) {
        for (const double entry : index.values) {
            const auto k = static_cast<std::int64_t>(entry);
            const auto start = x.values.begin() + (i * size + (k < 0 ? k + size : k)) * inner;
            y.values.insert(y.values.end(), start, start + inner);
        }
    }
    return y;
}
