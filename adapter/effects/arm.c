/*
@HEAD@
 *
 * q, dq, ddq: rad, rad/s, rad/s2 (m where a joint slides); tau: N m (N), what the joints' sensors
 * read: tau = bodies(q, dq, ddq) + effects. C99, no allocation, no other file; link with -lm.
 *
 *   adapter_torque(&state, q, dq, ddq, tau)   all of it: feed-forward for a motion asked for
 *   adapter_rigid(q, dq, ddq, tau)            the bodies alone
 *   adapter_gravity(q, tau)                   what they weigh
 *   adapter_effects(&state, q, dq, ddq, load, tau)   what effects add to tau; load: that of bodies
 *   adapter_wound(bent, step, way_length)     bristles after a step of the joint
 *
 * A state remembers how far bristles of friction are bent: one for each stream of instants, begun
 * by adapter_begin; NULL takes them as bent the way the joint moves. In MuJoCo's mjcb_passive take
 * adapter_effects off qfrc_passive, with ddq of zeros (armature stays in the model), where joints
 * have neither damping, frictionloss nor stiffness there.
 */
#include <math.h>

#define ADAPTER_JOINTS @JOINTS@

typedef struct {
    int begun;
    double q[ADAPTER_JOINTS];
    double bent[@BENT@];
} adapter_state;

void adapter_begin(adapter_state *state);
double adapter_wound(double bent, double step, double way_length);
void adapter_rigid(const double *q, const double *dq, const double *ddq, double *tau);
void adapter_gravity(const double *q, double *tau);
void adapter_effects(adapter_state *state, const double *q, const double *dq, const double *ddq,
                     const double *load, double *tau);
void adapter_torque(adapter_state *state, const double *q, const double *dq, const double *ddq,
                    double *tau);

void adapter_begin(adapter_state *state)
{
    const adapter_state nothing = {0};
    *state = nothing;
}

double adapter_wound(double bent, double step, double way_length)
{
    const double way = (step > 0.0) - (step < 0.0);
    return way + (bent - way) * exp(-fabs(step) / way_length);
}

static void wind(adapter_state *state, const double *q)
{
    int j;
    if (state->begun) {
@WIND@
    }
    for (j = 0; j < ADAPTER_JOINTS; ++j)
        state->q[j] = q[j];
    state->begun = 1;
}

void adapter_rigid(const double *q, const double *dq, const double *ddq, double *tau)
{
@RIGID@
}

void adapter_gravity(const double *q, double *tau)
{
    const double still[ADAPTER_JOINTS] = {0};
    adapter_rigid(q, still, still, tau);
}

void adapter_effects(adapter_state *state, const double *q, const double *dq, const double *ddq,
                     const double *load, double *tau)
{
    (void)dq, (void)ddq, (void)load;
    if (state)
        wind(state, q);
@LAWS@
}

void adapter_torque(adapter_state *state, const double *q, const double *dq, const double *ddq,
                    double *tau)
{
    double load[ADAPTER_JOINTS];
    int j;
    adapter_rigid(q, dq, ddq, load);
    for (j = 0; j < ADAPTER_JOINTS; ++j)
        tau[j] = load[j];
    adapter_effects(state, q, dq, ddq, load, tau);
}
