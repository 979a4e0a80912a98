#include "fusion/meeting.h"

void find_gates(const view_maps *reference, const view_maps *partner, const fusion_transfer *transfer,
                fusion_gates gates, const int32_t *rows, const int32_t *columns, ptrdiff_t count, uint8_t *gate,
                float *distance) {
    for (ptrdiff_t k = 0; k < count; k++) {
        const ptrdiff_t p = rows[k] * reference->width + columns[k];
        meeting met = {.gate = GATE_UNSEEN};
        if (reference->depth[p] > 0) {
            const sighting seen = sight(transfer, columns[k], rows[k], reference->depth[p]);
            met = meet(reference, partner, transfer, gates, p, seen);
        }
        gate[k] = (uint8_t)met.gate;
        distance[k] = met.gate == GATE_UNSEEN ? 0 : (float)sqrt(met.du * met.du + met.dv * met.dv);
    }
}
