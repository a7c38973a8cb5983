// A filter served to fuselog over standard input and output: call `fuselog::serve<Filter>(description, n, t, m)`.
//
// A Filter has a constructor from (const double *parameters, size_t count, uint64_t seed), and `start`, `take`,
// `predict`, `state` and `innovation` as in fuselog_filter.h, without the first argument; their return values
// have the same meaning. n, t and m are the components of state, tangent space and innovation.
#pragma once
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <memory>
#include <string>
#include <vector>

namespace fuselog {

inline void write(const std::string &frame)  // on little-endian machines
{
    const auto size = static_cast<uint32_t>(frame.size());
    std::fwrite(&size, sizeof size, 1, stdout);
    std::fwrite(frame.data(), 1, frame.size(), stdout);
    std::fflush(stdout);
}

template <typename Number> Number read(const std::string &frame, size_t at)
{
    Number number;
    std::memcpy(&number, frame.data() + at, sizeof number);
    return number;
}

inline std::vector<double> doubles(const std::string &frame, size_t at)
{
    std::vector<double> found((frame.size() - at) / sizeof(double) + 1);  // never empty
    std::memcpy(found.data(), frame.data() + at, frame.size() - at);
    return found;
}

template <typename Filter> void serve(const std::string &description, size_t n, size_t t, size_t m)
{
    std::unique_ptr<Filter> own;
    write("D{\"protocol\": 2, " + description.substr(description.find('{') + 1));
    for (uint32_t size; std::fread(&size, sizeof size, 1, stdin) == 1;) {
        std::string frame(size, '\0');
        if (std::fread(&frame[0], 1, size, stdin) != size)
            return;
        std::vector<double> state(n + t * t), innovation(m + m * m);
        int32_t status = 0, said = -1;
        bool wanted = frame[0] == 'P';
        if (frame[0] == 'C') {
            const auto parameters = doubles(frame, 9);
            own = std::make_unique<Filter>(parameters.data(), parameters.size() - 1, read<uint64_t>(frame, 1));
            continue;
        } else if (frame[0] == 'S') {
            const auto prior = doubles(frame, 14);
            const bool has = read<uint8_t>(frame, 13);
            status = own->start(read<int64_t>(frame, 5), has ? prior.data() : nullptr, has ? &prior[n] : nullptr);
        } else if (frame[0] == 'T') {
            wanted = read<uint8_t>(frame, 17);
            status = own->take(read<int32_t>(frame, 5), read<int64_t>(frame, 9), doubles(frame, 18).data());
            said = m > 0 ? own->innovation(innovation.data(), innovation.data() + m) : -1;
        } else {
            status = own->predict(read<int64_t>(frame, 5));
        }
        const bool tells = status <= 0 && wanted && own->state(state.data(), state.data() + n) == 0;
        const bool measured = status <= 0 && (said == 0 || said == -2);
        const uint8_t flags = tells | measured << 1 | (measured && said == -2) << 2;
        std::string reply = "R" + frame.substr(1, 4);  // the number of the answered frame
        reply.append(reinterpret_cast<const char *>(&status), sizeof status).append(1, static_cast<char>(flags));
        if (tells)
            reply.append(reinterpret_cast<const char *>(state.data()), state.size() * sizeof(double));
        if (measured)
            reply.append(reinterpret_cast<const char *>(innovation.data()), innovation.size() * sizeof(double));
        write(reply);
    }
}

}  // namespace fuselog
