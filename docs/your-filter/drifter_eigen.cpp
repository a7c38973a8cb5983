// The drifter of docs/your-filter.md with Eigen and the interface of fuselog_filter.h: -e lib:./drifter_eigen.so
#include "fuselog_filter.h"

#include <Eigen/Dense>
#include <new>

using Vector = Eigen::Vector2d;
using Matrix = Eigen::Matrix<double, 2, 2, Eigen::RowMajor>;

namespace {

const char *const DESCRIPTION = R"json({
    "summary": "a drifter with position fixes, in C++ with Eigen",
    "topics": [{"topic": "fix", "fields": ["position_m[2]", "covariance_m2[4]"]}],
    "prior": "prior", "truth": "truth",
    "state": {"x_m": "linear", "y_m": "linear"},
    "innovation": {"x_m": "linear", "y_m": "linear"},
    "parameters": {"drift_density": {"default": 20, "minimum": 0, "unit": "m/sqrt(s)",
                                     "role": "process noise"}}
})json";

struct Drifter {
    double density = 0.0;
    int64_t time_ns = 0;
    Vector mean = Vector::Zero(), difference = Vector::Zero();
    Matrix covariance = 1e6 * Matrix::Identity(), spread = Matrix::Identity();
};

Drifter &own(void *filter) { return *static_cast<Drifter *>(filter); }
const Drifter &own(const void *filter) { return *static_cast<const Drifter *>(filter); }

}  // namespace

extern "C" {

int32_t fuselog_filter_version(void) { return FUSELOG_FILTER_VERSION; }
const char *fuselog_filter_describe(void) { return DESCRIPTION; }

void *fuselog_filter_create(const double *parameters, uint64_t)
{
    auto *made = new (std::nothrow) Drifter;
    if (made)
        made->density = parameters[0];
    return made;
}

void *fuselog_filter_copy(const void *filter) { return new (std::nothrow) Drifter(own(filter)); }
void fuselog_filter_destroy(void *filter) { delete static_cast<Drifter *>(filter); }

int32_t fuselog_filter_start(void *filter, int64_t time_ns, const double *mean, const double *covariance)
{
    own(filter).time_ns = time_ns;
    if (mean) {
        own(filter).mean = Eigen::Map<const Vector>(mean);
        own(filter).covariance = Eigen::Map<const Matrix>(covariance);
    }
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_predict(void *filter, int64_t time_ns)
{
    auto &drifter = own(filter);
    const double duration_s = static_cast<double>(time_ns - drifter.time_ns) * 1e-9;
    drifter.covariance += drifter.density * drifter.density * duration_s * Matrix::Identity();
    drifter.time_ns = time_ns;
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_take(void *filter, int32_t, int64_t time_ns, const double *fields)
{
    auto &drifter = own(filter);
    fuselog_filter_predict(filter, time_ns);
    drifter.difference = Eigen::Map<const Vector>(fields) - drifter.mean;
    drifter.spread = drifter.covariance + Eigen::Map<const Matrix>(fields + 2);
    const Matrix gain = drifter.covariance * drifter.spread.inverse();
    drifter.mean += gain * drifter.difference;
    drifter.covariance -= (gain * drifter.covariance).eval();
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_state(const void *filter, double *mean, double *covariance)
{
    Eigen::Map<Vector>{mean} = own(filter).mean;
    Eigen::Map<Matrix>{covariance} = own(filter).covariance;
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_innovation(const void *filter, double *innovation, double *covariance)
{
    Eigen::Map<Vector>{innovation} = own(filter).difference;
    Eigen::Map<Matrix>{covariance} = own(filter).spread;
    return FUSELOG_FILTER_WELL;
}

}  // extern "C"
