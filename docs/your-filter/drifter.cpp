// The drifter of docs/your-filter.md as a program that answers messages: -e "exec:./drifter".
#include "client.hpp"

#include <cmath>

static const char *DESCRIPTION = R"json({
    "summary": "a drifter with position fixes",
    "topics": [{"topic": "fix", "fields": ["position_m[2]", "covariance_m2[4]"]}],
    "prior": "prior", "truth": "truth",
    "state": {"x_m": "linear", "y_m": "linear"},
    "innovation": {"x_m": "linear", "y_m": "linear"},
    "parameters": {"drift_density": {"default": 20, "minimum": 0, "unit": "m/sqrt(s)",
                                     "role": "process noise",
                                     "meaning": "random walk of the position"}}
})json";

class Drifter {
public:
    Drifter(const double *parameters, size_t, uint64_t) : density_(parameters[0]) {}

    int32_t start(int64_t time_ns, const double *mean, const double *covariance)
    {
        time_ns_ = time_ns;
        for (int axis = 0; axis < 2; axis++) {
            mean_[axis] = mean ? mean[axis] : 0.0;
            variance_[axis] = covariance ? covariance[3 * axis] : 1e6;
        }
        return 0;
    }

    int32_t predict(int64_t time_ns)
    {
        for (double &variance : variance_)
            variance += density_ * density_ * static_cast<double>(time_ns - time_ns_) * 1e-9;
        time_ns_ = time_ns;
        return 0;
    }

    int32_t take(int32_t, int64_t time_ns, const double *fields)
    {
        predict(time_ns);
        for (int axis = 0; axis < 2; axis++) {
            spread_[axis] = variance_[axis] + fields[2 + 3 * axis];
            difference_[axis] = fields[axis] - mean_[axis];
            mean_[axis] += variance_[axis] / spread_[axis] * difference_[axis];
            variance_[axis] -= variance_[axis] / spread_[axis] * variance_[axis];
        }
        return 0;
    }

    int32_t state(double *mean, double *covariance) const { return tell(mean_, variance_, mean, covariance); }

    int32_t innovation(double *difference, double *spread) const
    {
        return tell(difference_, spread_, difference, spread);
    }

private:
    static int32_t tell(const double *vector, const double *diagonal, double *told, double *matrix)
    {
        for (int axis = 0; axis < 2; axis++) {
            told[axis] = vector[axis];
            matrix[3 * axis] = diagonal[axis];
            matrix[1 + axis] = 0.0;
        }
        return 0;
    }

    double density_, mean_[2], variance_[2], difference_[2], spread_[2];
    int64_t time_ns_ = 0;
};

int main() { fuselog::serve<Drifter>(DESCRIPTION, 2, 2, 2); }
