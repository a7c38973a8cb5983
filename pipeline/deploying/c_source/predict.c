/*% if made.steps.gap is not none %*/
/* Over a gap of the control, the mean stays and the covariance grows. */
static NAME_outcome pass_gap(NAME *filter, int64_t time_ns, const NAME_parameters *parameters)
{
${gap}}

/*% endif %*/
/*% if made.is_interpolated %*/
static NAME_outcome predict(NAME *filter, int64_t time_ns, const NAME_parameters *parameters)
{
${step}}

NAME_outcome NAME_predict(NAME *filter, int64_t time_ns, const REAL *control,
    const NAME_parameters *parameters)
{
    NAME_outcome outcome = checked(filter);
    if (time_ns < filter->time_ns)
        return NAME_BACKWARD;
    for (int k = 0; k < NAME_CONTROLS; k++)
        if (isinf(control[k]) || isinf(filter->control[k]))
            return NAME_BAD_INPUT;
    if (time_ns > filter->time_ns) {
/*% if made.has_gaps %*/
        if (isnan(control[0]))
            filter->is_in_gap = 1;
        if (${"isnan(control[0])" if made.steps.gap is not none else "filter->is_in_gap"})
            return NAME_NOT_DRIVEN;
/*% if made.steps.gap is not none %*/
        if (filter->is_in_gap) {
            if (!is_finite(control, NAME_CONTROLS))
                return NAME_BAD_INPUT;
            for (int k = 0; k < NAME_CONTROLS; k++)
                filter->control[k] = control[k];
            return pass_gap(filter, time_ns, parameters);
        }
/*% endif %*/
/*% endif %*/
        if (!is_finite(control, NAME_CONTROLS))
            return NAME_BAD_INPUT;
        for (int k = 0; k < NAME_CONTROLS; k++) /* the first control holds from the start on */
            filter->control[k] =
                isnan(filter->control[k]) ? control[k] : 0.5_S * (filter->control[k] + control[k]);
        outcome = predict(filter, time_ns, parameters);
    }
    for (int k = 0; k < NAME_CONTROLS; k++)
        if (!isnan(control[k]))
            filter->control[k] = control[k];
    return outcome;
}
/*% else %*/
NAME_outcome NAME_predict(NAME *filter, int64_t time_ns,
    const NAME_parameters *parameters)
{
    if (time_ns < filter->time_ns)
        return NAME_BACKWARD;
    if (time_ns == filter->time_ns)
        return checked(filter);
/*% if made.controls %*/
    if (!is_finite(filter->control, NAME_CONTROLS))
        return NAME_BAD_INPUT;
/*% endif %*/
${step}}
/*% endif %*/
