// Evaluates a model that `python -m pirl_rl.export ... format=onnx` wrote, with the standard library alone.
//
//     g++ -std=c++17 -O2 evaluate.cpp -o evaluate
//     echo "2.0 0.5" | ./evaluate model.onnx
//
// Each line of the input is a time to go in s and the coordinates of a state in SI units. Each line of the output has V,
// its gradient in the state, per unit of each coordinate, and the control in SI units.
#include <cstdio>
#include <exception>
#include <iostream>
#include <sstream>

#include "model.hpp"

int main(int count, char** arguments) {
    if (count != 2) {
        std::fprintf(stderr, "usage: evaluate MODEL.onnx < STATES\n");
        return 2;
    }
    try {
        const Model model(arguments[1]);
        std::string line;
        while (std::getline(std::cin, line)) {
            std::istringstream words(line);
            const std::vector<double> row{std::istream_iterator<double>(words), std::istream_iterator<double>()};
            if (static_cast<std::int64_t>(row.size()) != 1 + model.states()) {
                throw std::runtime_error("expected tau and " + std::to_string(model.states()) +
                                         " coordinates in each line, got: " + line);
            }
            const auto answer = model({row[0]}, {row.begin() + 1, row.end()});
            for (const char* name : {"value", "gradient", "control"}) {
                for (const double entry : answer.at(name).values) std::printf("%.9g ", entry);
            }
            std::printf("\n");
        }
    } catch (const std::exception& error) {
        std::fprintf(stderr, "error: %s\n", error.what());
        return 1;
    }
}
