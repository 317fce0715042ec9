"""Areas and arcs, normalized cut, transition model, area matching, hypotheses, globally consistent map."""
